"""The module `snarfcli.deformer`, for tools that read code without running it."""

from snarfcli.deformer import *  # noqa: F403
