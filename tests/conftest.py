"""Puts this folder on the path, so that tests can import the toys in it, and keeps torch to few threads."""

from __future__ import annotations

import torch

torch.set_num_threads(min(2, torch.get_num_threads()))
