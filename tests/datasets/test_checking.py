"""`snarf doctor data=...`: what it says about a data set, and its figure."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_animal import animal_motion, make_animal
from toy_animal_files import animal_glb, write_animal_meshes, write_mesh

from snarfcli.bodies import axis_angle_to_matrix, matrix_to_axis_angle
from snarfcli.commands import doctor
from snarfcli.commands.doctor import DoctorConfig
from snarfcli.datasets.settings import DataConfig
from snarfcli.errors import UserError

ANIMAL = make_animal(0.08)
MOTIONS = [animal_motion(name, 4) for name in ("walk", "sit")]


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    write_animal_meshes(folder / "rex", ANIMAL, MOTIONS)
    return folder


@pytest.fixture
def bad(good, tmp_path) -> Path:
    """A copy to break."""
    return Path(shutil.copytree(good, tmp_path / "bad"))


def checked(caplog, folder: Path, **settings) -> tuple[int, list[str]]:
    """Check the data in `folder` and return the exit code and the lines."""
    caplog.clear()
    caplog.set_level("INFO", logger="snarfcli")
    data = DataConfig("meshes", 1, 1, 1, folder=str(folder))
    config = DoctorConfig("nowhere", str(folder.parent / "outputs"), data, **settings)
    return doctor.run(config), [record.getMessage() for record in caplog.records]


def line_with(lines: list[str], part: str) -> str:
    found = [line for line in lines if part in line]
    assert found, "\n".join(lines)
    return found[0]


def test_a_good_folder_is_usable_and_drawn(caplog, good):
    from PIL import Image

    code, lines = checked(caplog, good)
    assert code == 0
    assert line_with(lines, "subjects: rex")
    assert line_with(lines, "19 joints, 18 bones; canonical pose: the rest pose")
    assert line_with(lines, "scaled by")
    assert line_with(lines, "278 vertices, 552 faces, the same in all 6 frames")
    assert line_with(lines, "100 % of the joints are inside the meshes")
    assert "  poses           surface at a bone moves by 0.2 cm between frames (median of 18 bones, 6 frames)" in lines
    assert lines[-1] == f'usable; next: "snarf preprocess data=meshes subject=rex data.folder={good} data_root=nowhere"'
    path = good.parent / "outputs" / "doctor" / "meshes_rex.png"
    assert str(path) in line_with(lines, "  figure ")
    picture = np.asarray(Image.open(path).convert("RGB")).astype(int)
    orange = (np.abs(picture - (235, 94, 40)).sum(-1) < 30).sum()
    assert picture.shape[1] > 1000
    assert orange > 2000


def test_another_place_for_the_figure(caplog, good, tmp_path):
    assert checked(caplog, good, subject="rex", figure=str(tmp_path / "look.png"))[0] == 0
    assert (tmp_path / "look.png").stat().st_size > 10_000


def test_skeletons_that_do_not_fit_are_a_problem(caplog, bad):
    content = dict(np.load(bad / "rex" / "skeleton.npz"))
    np.savez(bad / "rex" / "skeleton.npz", **content | {"joints": content["joints"] + (0, 3, 0)})
    code, lines = checked(caplog, bad)
    assert code == 2
    assert "PROBLEM: 0 % of the joints are inside the meshes" in line_with(lines, "  fit ")
    assert "units, axes and frame order" in line_with(lines, "  fit ")
    assert lines[-1].startswith("not usable as it is: rex")


@pytest.mark.parametrize(("degrees", "shift_m"), [(2, 0.01), (5, 0.02)])
def test_poses_that_are_wrong_in_every_frame_are_a_warning(caplog, bad, degrees, shift_m):
    random = np.random.default_rng(0)
    for motion in MOTIONS:
        path = bad / "rex" / motion.name / "poses.npz"
        content = dict(np.load(path))
        turns = torch.from_numpy(random.normal(0, np.deg2rad(degrees) / 1.6, motion.poses.shape))  # mean angle: 1.6 sigma
        turned = axis_angle_to_matrix(torch.from_numpy(motion.poses)) @ axis_angle_to_matrix(turns)
        shifts = random.normal(0, shift_m / np.sqrt(3), motion.translation.shape)
        poses = matrix_to_axis_angle(turned).flatten(1).numpy()
        np.savez(path, **content | {"poses": poses, "trans": content["trans"] + shifts})
    code, lines = checked(caplog, bad)
    assert code == 0
    line = line_with(lines, "  poses           warning: surface at a bone moves by ")
    assert "cm between frames (median of 18 bones, 6 frames), wanted less than 0." in line
    assert "; training.refine_poses=true corrects the poses while training; or repair them" in line
    assert lines[-1].startswith("usable; next:")


def test_open_inside_out_and_oddly_sized_meshes_are_told(caplog, bad):
    for motion in MOTIONS:
        for frame, vertices in enumerate(ANIMAL.posed(motion)):
            write_mesh(bad / "rex" / motion.name / f"frame_{frame}.obj", vertices, ANIMAL.faces[5:, ::-1])
    content = dict(np.load(bad / "rex" / "skeleton.npz"))
    (bad / "rex" / "skeleton.npz").unlink()
    content = {name: array.tolist() for name, array in content.items()} | {"scale": 9.0}
    (bad / "rex" / "skeleton.json").write_text(json.dumps(content))
    code, lines = checked(caplog, bad)
    assert code == 2
    assert "warning: 6 of 6 are open, up to" in line_with(lines, "  open meshes ")
    assert "encloses a negative volume; reverse the order of its faces" in line_with(lines, "  inside out      PROBLEM")
    assert "warning: " in line_with(lines, "is not the size of a person")


def test_closed_meshes_inside_out_and_broken_files_are_named(caplog, bad):
    vertices = ANIMAL.posed(MOTIONS[0])[0]
    write_mesh(bad / "rex" / "walk" / "frame_0.obj", vertices, ANIMAL.faces[:, ::-1])
    (bad / "rex" / "sit" / "frame_3.obj").write_text("v 0 0\n")
    code, lines = checked(caplog, bad)
    assert code == 2
    assert "walk, frame 0: the mesh is inside out" in line_with(lines, "walk, frame 0")
    assert "frame_3.obj cannot be read" in line_with(lines, "frame_3.obj")


def test_broken_sequences_and_missing_things_are_problems_without_a_trace(caplog, bad):
    (bad / "rex" / "sit" / "frame_3.obj").unlink()
    code, lines = checked(caplog, bad)
    assert code == 2
    assert "PROBLEM: sit: " in line_with(lines, "  broken ")
    assert "wanted 4 meshes, one per frame of poses.npz, got 3" in line_with(lines, "  broken ")
    (bad / "rex" / "skeleton.npz").write_bytes(b"nothing")
    code, lines = checked(caplog, bad)
    assert code == 2
    assert "PROBLEM: skeleton file" in line_with(lines, "  not usable ")
    with pytest.raises(UserError, match="does not exist"):
        checked(caplog, bad.parent / "nothing")


def test_a_fault_of_the_program_is_a_line_too(caplog, good, monkeypatch):
    from snarfcli.datasets import meshes

    monkeypatch.setattr(meshes, "load", lambda subject, request: 1 / 0)
    code, lines = checked(caplog, good)
    assert code == 2
    assert "PROBLEM: ZeroDivisionError: division by zero" in line_with(lines, "  not usable ")


def test_several_subjects_are_checked_and_the_others_named(caplog, tmp_path):
    for name in "abcd":
        (tmp_path / f"{name}.glb").write_bytes(animal_glb(ANIMAL, MOTIONS))
    code, lines = checked(caplog, tmp_path)
    assert code == 0
    assert "1 more subjects were not checked; give subject=NAME or subject=all" in lines
    assert [line for line in lines if line.startswith("subject ")] == ["subject a", "subject b", "subject c"]
    assert line_with(lines, "rigged file")
