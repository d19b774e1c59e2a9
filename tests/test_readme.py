"""The examples of the README that need no avatar run as they stand."""

from __future__ import annotations

from pathlib import Path

import torch
from documents import python_examples, run_examples

README = Path(__file__).parents[1] / "README.md"


def test_the_examples_of_the_deformer_run():
    examples = [text for text in python_examples(README) if "ForwardDeformer" in text]
    assert len(examples) == 2
    torch.manual_seed(0)
    names = run_examples(README, examples)
    assert names["posed_values"].shape == (1, 1000)
    inside = names["posed_values"] > -0.1
    assert 10 < int(inside.sum()) < 500
    assert names["deformer"].num_bones == 24


def test_every_example_is_python():
    assert len(python_examples(README)) >= 4
    for text in python_examples(README):
        compile(text, README.name, "exec")
