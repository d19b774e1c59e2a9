"""What all examples have in common: they need PyTorch and NumPy only, and the documentation names them."""

from __future__ import annotations

from pathlib import Path

import pytest
from light_install import run_light

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def test_they_import_without_extras_and_without_the_compiler():
    """PyTorch's compiler takes seconds to import."""
    names = ", ".join(path.stem for path in EXAMPLES)
    done = run_light(
        f"import torch; loaded = 'torch._dynamo' in sys.modules; sys.path.insert(0, {str(ROOT / 'examples')!r}); "
        f"import {names}; print(('torch._dynamo' in sys.modules) == loaded)"
    )
    assert done.stdout == "True\n", done.stderr


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_each_has_a_test_and_is_named_in_the_documentation(path):
    assert (ROOT / "tests/examples" / f"test_{path.name}").is_file()
    assert f"examples/{path.name}" in (ROOT / "docs/library.md").read_text()
    assert f"python examples/{path.name}" in path.read_text()
