"""The package has two names, `snarf` and `snarfcli`, and each of its modules is loaded once."""

from __future__ import annotations

import ast
import importlib
import pickle
import re
import subprocess
import sys
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import pytest

import snarf
import snarfcli

ROOT = Path(snarf.__file__).parents[1]
PATHS = [path for path in sorted((ROOT / "snarf").rglob("*.py")) if path.parent.name != "snarf" or path.stem[0] != "_"]
STATIC = [path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".").removesuffix(".__init__") for path in PATHS]


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)


def test_modules_and_objects_are_the_same():
    import snarf.deformer.grid
    from snarf.deformer.grid import CanonicalGrid

    import snarf.bodies
    from snarf.deformer import ForwardDeformer

    assert snarf.deformer is sys.modules["snarfcli.deformer"] is sys.modules["snarf.deformer"]
    assert snarf.deformer.grid is sys.modules["snarfcli.deformer.grid"] is sys.modules["snarf.deformer.grid"]
    assert ForwardDeformer is snarf.ForwardDeformer is snarfcli.ForwardDeformer
    assert (snarf.deformer.__name__, snarf.deformer.__spec__.name) == ("snarfcli.deformer",) * 2
    assert pickle.loads(pickle.dumps(CanonicalGrid)) is snarfcli.CanonicalGrid
    assert files("snarf.bodies").joinpath("body_cc0.npz").is_file()


@pytest.mark.parametrize("first", ["snarf", "snarfcli"])
def test_no_module_is_executed_twice(first):
    """PyTorch refuses operators that are registered twice. Modules of either name are imported by either order."""
    second = {"snarf": "snarfcli", "snarfcli": "snarf"}[first]
    names = ["deformer.ops", "networks.perceptron", "bodies", "shape.network"]
    code = f"""
import importlib, sys
names = {names!r}
one = [importlib.import_module("{first}." + name) for name in names]
two = [importlib.import_module("{second}." + name) for name in names]
assert all(a is b for a, b in zip(one, two))
files = [module.__file__ for name, module in sys.modules.items() if name.startswith("snarfcli.")]
assert len(set(files)) == len(files)
"""
    done = run(code)
    assert done.returncode == 0, done.stderr


def test_threads_import_one_module_by_both_names():
    code = """
import importlib
from concurrent.futures import ThreadPoolExecutor
with ThreadPoolExecutor(8) as threads:
    modules = list(threads.map(importlib.import_module, ["snarf.bodies", "snarfcli.bodies"] * 8))
assert len(set(map(id, modules))) == 1
"""
    done = run(code)
    assert done.returncode == 0, done.stderr


def test_public_names():
    assert {"Avatar", "ForwardDeformer", "builtin_body", "find_correspondences", "load_body"} <= set(snarf.__all__)
    assert snarf.__all__ == snarfcli.__all__
    for package in (snarf, snarfcli):
        assert set(package.__all__) | {"bodies", "deformer", "export"} <= set(dir(package))
        for name in dir(package):
            assert getattr(package, name) is not None or name == "__cached__"
    for name in snarf.__all__:
        assert getattr(snarf, name) is getattr(snarfcli, name)


@pytest.mark.parametrize("package", [snarf, snarfcli])
def test_names_that_do_not_exist(package):
    with pytest.raises(AttributeError, match=f"module '{package.__name__}' has no attribute 'no_such_name'"):
        _ = package.no_such_name
    with pytest.raises(ModuleNotFoundError, match=f"No module named '{package.__name__}.no_such_name'"):
        importlib.import_module(f"{package.__name__}.no_such_name")
    assert find_spec(f"{package.__name__}.no_such_name") is None


@pytest.mark.parametrize("is_imported", [False, True])
def test_the_source_can_be_inspected(is_imported):
    """Once the module is imported, the loader is the one of its own name, which depends on how the package is installed."""
    code = f"""
import inspect, snarf
from importlib.util import find_spec
if {is_imported}:
    import snarf.deformer.grid
spec = find_spec("snarf.deformer.grid")
assert spec.origin == snarf.CanonicalGrid.to.__code__.co_filename
assert "canonical voxel grid" in spec.loader.get_source(spec.name)
assert "CanonicalGrid" in spec.loader.get_code(spec.name).co_names
assert "class CanonicalGrid" in inspect.getsource(snarf.CanonicalGrid)
"""
    done = run(code)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", STATIC)
def test_files_for_tools_name_the_module_that_is_loaded(name):
    """They are not executed. Each has what a type checker and an editor need: an import of everything in the module."""
    own = name.replace("snarf", "snarfcli", 1)
    assert importlib.import_module(name) is importlib.import_module(own)
    path = ROOT / (name.replace(".", "/") + ".py")
    if path.exists():
        (imported,) = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.ImportFrom)]
        assert (imported.module, imported.names[0].name) == (own, "*")
        assert importlib.import_module(own).__all__


def test_modules_in_the_documentation_have_files_for_tools():
    text = "\n".join((ROOT / page).read_text() for page in ("README.md", "docs/python.md", "docs/library.md"))
    used = set(re.findall(r"^\s*(?:from|import) (snarf\.[\w.]+)", text, re.MULTILINE))
    assert used
    assert used <= set(STATIC)


def test_the_module_is_the_command():
    done = subprocess.run([sys.executable, "-m", "snarf", "--version"], capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stdout) == (0, f"snarf {snarf.__version__}\n")
