"""The examples of the README that need no avatar run as they stand."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch

README = Path(__file__).parents[1] / "README.md"


def python_examples() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", README.read_text(), re.MULTILINE | re.DOTALL)


def test_the_examples_of_the_deformer_run():
    examples = [text for text in python_examples() if "ForwardDeformer" in text]
    assert len(examples) == 2
    names: dict[str, Any] = {}
    torch.manual_seed(0)
    for text in examples:
        exec(compile(text, README.name, "exec"), names)
    assert names["posed_values"].shape == (1, 1000)
    inside = names["posed_values"] > -0.1
    assert 10 < int(inside.sum()) < 500
    assert names["deformer"].num_bones == 24


def test_every_example_is_python():
    assert len(python_examples()) >= 4
    for text in python_examples():
        compile(text, README.name, "exec")
