"""Without extras: the core works with PyTorch and NumPy alone, and everything else says in one line what to install."""

from __future__ import annotations

import ast
import pickle
import re
import sys
from pathlib import Path

import pytest
from light_install import hidden_modules, run_light
from smpl_files import smpl, write_pickle

from snarfcli import extras
from snarfcli.errors import UserError
from snarfcli.extras import MissingPackage

ROOT = Path(__file__).parents[2]
INSTALL = "pip install 'snarf[commands]'"


def test_the_core_needs_pytorch_and_numpy_only(tmp_path):
    assert {"scipy", "igl", "skimage", "PIL", "hydra", "omegaconf", "tqdm"} <= hidden_modules()
    body = write_pickle(tmp_path / "basicmodel_f_lbs_10_207_0_v1.1.0.pkl", smpl())  # with SciPy's sparse matrices
    code = f"""
import torch
from snarfcli.bodies import builtin_body, load_body
from snarfcli.deformer import CanonicalGrid, ForwardDeformer, PresetWeights, SkinningConfig, find_correspondences
from snarfcli.models.trained_field import TrainedField
from snarfcli.networks import run_perceptron
from snarfcli.native.backend import choose_backend
from snarfcli.progress import progress_bar
from snarfcli.shape import OccupancyNetwork

body = load_body({str(body)!r})
assert torch.equal(body.joint_regressor, builtin_body().joint_regressor) and body.num_joints == 24
skeleton = body.skeleton()
grid = CanonicalGrid.around(body.v_template, (0.4, 0.2, 0.2))
shape = (5, 9, 9)
deformer = ForwardDeformer(grid, 24, SkinningConfig(resolution=[9, 9, 5]))
transforms = skeleton.posed_from_canonical(skeleton.canonical_pose[None])
points = body.v_template[None, ::100]
found = deformer(points, transforms)
assert bool(found.found.all())
found.canonical.sum().backward()
assert ForwardDeformer.from_body({str(body)!r}, resolution=(9, 9, 5)).body.vertices.shape == (6890, 3)
weights = PresetWeights.from_vertices(body.v_template, body.weights, grid, shape).at_nodes().reshape(*shape, 24)
assert bool(find_correspondences(points, transforms, weights, grid).found.all())
left = {sorted(hidden_modules())!r}
assert not set(left) & {{name.partition(".")[0] for name in sys.modules}}
"""
    done = run_light(code)
    assert done.returncode == 0, done.stderr


def test_every_module_works_or_says_what_to_install():
    code = """
import importlib, pathlib, snarfcli
from snarfcli.extras import MissingPackage

# not `pkgutil.walk_packages`: the native library looks like a module, and an editable installation has other folders too
folder = pathlib.Path(snarfcli.__file__).parent
for path in sorted(folder.rglob("*.py")):
    name = ".".join(["snarfcli", *path.relative_to(folder).with_suffix("").parts]).removesuffix(".__init__")
    try:
        importlib.import_module(name)
    except MissingPackage:
        print(name.split(".")[1])
    except ModuleNotFoundError:
        if not name.startswith("snarfcli.formats.") and not name.endswith("blender_job"):
            raise
"""
    done = run_light(code)
    assert done.returncode == 0, done.stderr
    rooms = {
        "avatar",
        "cli",
        "commands",
        "datasets",
        "evaluation",
        "export",
        "fitting",
        "registration",
        "scanned_subjects",
        "meshing",
        "motions",
        "rendering",
        "reproduce",
    }
    assert set(done.stdout.split()) == rooms | {"extras", "point_clouds", "samples", "sampling", "training", "viewer"}


def test_public_names_say_what_to_install():
    code = """
import snarf
from snarf import *

assert "load_body" in snarf.__all__ and "Avatar" not in snarf.__all__
assert not [name for name in dir(snarf) if not hasattr(snarf, name)]  # as help() needs it
import snarf.motions
"""
    done = run_light(code)
    last = done.stderr.splitlines()[-1]
    assert last.startswith("snarfcli.extras.MissingPackage: this part of snarf needs packages that are not installed (")
    assert "libigl" in last
    assert last.endswith(f"install them with: {INSTALL}")


def test_commands_say_what_to_install():
    code = """
from snarfcli.cli.main import main
assert [main(arguments) for arguments in (["--help"], ["--version"], ["eval", "--help"])] == [0, 0, 0]
assert [main(arguments) for arguments in (["train", "subject=50002"], ["eval", "--ood"], ["doctor"])] == [2, 2, 2]
"""
    done = run_light(code)
    assert done.returncode == 0, done.stderr
    assert "usage: snarf COMMAND" in done.stdout
    for line, command in zip(done.stderr.splitlines(), ("train", "eval", "doctor"), strict=True):
        assert line.startswith(f"snarf {command}: this part of snarf needs packages that are not installed (hydra-core, ")
        assert line.endswith(INSTALL)


def test_the_error_is_a_user_error_and_an_import_error(monkeypatch):
    monkeypatch.setattr(extras, "_PACKAGES", {"name": {"json": "a-package", "no_such_module_b": "b-package"}})
    with pytest.raises(MissingPackage, match=r"\(b-package\); install them with: pip install 'snarf\[name\]'") as caught:
        extras.require_packages("name")
    assert isinstance(caught.value, UserError)
    assert isinstance(caught.value, ImportError)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_only_meshlab_is_left_out_of_the_extra_without_gpl():
    lists = {
        name: set(re.findall(r'^ +"(.*?)"', content, re.MULTILINE))
        for name, content in re.findall(
            r"^([\w-]+) = \[\n(.*?)^\]", (ROOT / "pyproject.toml").read_text(), re.DOTALL | re.MULTILINE
        )
    }
    left_out = lists["commands"] - lists["commands-without-gpl"]
    assert [re.match(r"[\w-]+", name)[0] for name in left_out] == ["pymeshlab"]
    assert lists["commands-without-gpl"] < lists["commands"]


def test_the_extra_has_every_package_that_is_imported():
    project = (ROOT / "pyproject.toml").read_text()
    lists = re.findall(r"^(\S+) = \[(.*?)\]$", project, re.MULTILINE | re.DOTALL)
    listed = {name: set(re.findall(r'"([\w-]+)[><=]', content)) for name, content in lists}
    assert listed["dependencies"] == {"numpy", "torch"}
    packages = {"hydra": "hydra-core", "igl": "libigl", "PIL": "pillow", "skimage": "scikit-image"}
    allowed = listed["commands"] | listed["dependencies"]
    allowed |= listed["view"] | listed["blender"] | listed["hub"]
    allowed |= {"omegaconf", "msgspec", "typing-extensions", "websockets"}  # which come with hydra-core, viser and torch
    own = {"snarfcli", *sys.stdlib_module_names}
    for path in (ROOT / "snarfcli").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [name.name for name in node.names] if isinstance(node, ast.Import) else []
            for top in {name.partition(".")[0] for name in names} - own:
                assert packages.get(top, top.replace("_", "-")) in allowed, path


@pytest.mark.parametrize("extra", ["test", "docs", "joblib", "submitit", "view", "hub", "blender"])
def test_other_extras_bring_the_commands(extra):
    (content,) = re.findall(rf"^{extra} = \[(.*?)\]$", (ROOT / "pyproject.toml").read_text(), re.MULTILINE | re.DOTALL)
    assert '"snarf[commands]"' in content
