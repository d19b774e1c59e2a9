"""How large a subject is, also in scans that show the floor; and what `data=meshes` says about it and about odd angles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from toy_animal import Animal, animal_motion, make_animal
from toy_animal_files import animal_glb, write_animal_meshes, write_mesh
from toy_rigs import a_pose, rig_of
from toy_vrm import human_vrm

from snarfcli.datasets import meshes
from snarfcli.datasets.builtin import builtin_subject
from snarfcli.datasets.checking import check_subject
from snarfcli.datasets.mesh_folders import subject_places
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.datasets.subject_size import near_bones, subject_length
from snarfcli.errors import UserError

FRAMES = 3


@pytest.fixture(scope="module")
def animal() -> Animal:
    return make_animal(0.1)


def request(folder: Path, **settings) -> Request:
    return Request(DataConfig("meshes", 1, 1, 1, folder=str(folder), **settings), Path("nowhere"))


def write_scans(folder: Path, animal: Animal, *, unit: float = 1.0, floor_m: float = 0.0) -> None:
    """Write two sequences in other units; each mesh has a square floor of this side below it."""
    motions = [animal_motion(name, FRAMES) for name in ("sit", "walk")]
    write_animal_meshes(folder / "rex", animal, motions)
    np.savez(
        folder / "rex" / "skeleton.npz",
        names=np.array(animal.names),
        parents=np.array(animal.parents),
        joints=unit * animal.joints,
    )
    for motion in motions:
        path = folder / "rex" / motion.name
        content = dict(np.load(path / "poses.npz"))
        np.savez(path / "poses.npz", **content | {"trans": unit * content["trans"]})
        for frame, vertices in enumerate(animal.posed(motion)):
            faces, side = animal.faces, np.linspace(-floor_m / 2, floor_m / 2, 30)
            if floor_m:
                grid = np.stack(np.meshgrid(side, [vertices[:, 1].min()], side), -1).reshape(-1, 3)
                at = np.arange(900).reshape(30, 30)
                first, second = at[:-1, :-1].ravel(), at[1:, :-1].ravel()
                third, fourth = at[1:, 1:].ravel(), at[:-1, 1:].ravel()
                below = np.concatenate([np.stack([first, second, third], 1), np.stack([first, third, fourth], 1)])
                faces = np.concatenate([faces, below + len(vertices)])
                vertices = np.concatenate([vertices, grid])
            write_mesh(path / f"frame_{frame}.obj", unit * vertices, faces)


def remarks(folder: Path) -> dict[str, tuple[str, str]]:
    return {mark.name: (mark.kind, mark.text) for mark in check_subject("rex", request(folder))}


@pytest.mark.parametrize("floor_m", [2.0, 4.0, 20.0])
@pytest.mark.parametrize("unit", [1.0, 100.0])
def test_a_floor_does_not_shrink_the_subject(tmp_path, animal, floor_m, unit):
    write_scans(tmp_path / "plain", animal, unit=unit)
    write_scans(tmp_path / "floor", animal, unit=unit, floor_m=floor_m)
    plain, with_floor = (meshes.load("rex", request(tmp_path / name)) for name in ("plain", "floor"))
    height = [float(np.ptp(subject.skeleton.joints_rest.numpy(), axis=0).max()) for subject in (plain, with_floor)]
    assert height[1] == pytest.approx(height[0], rel=0.15)  # the part of the floor near the feet counts
    (line,) = (line for line in with_floor.sources if "near the bones, the whole mesh" in line)
    assert "data.scale=NUMBER sets it" in line
    found = remarks(tmp_path / "floor")
    assert found["surroundings"][0] == "warning"
    assert "a floor or other things, which would be learned as a part of the subject" in found["surroundings"][1]
    assert "surroundings" not in remarks(tmp_path / "plain")


def test_the_setting_wins(tmp_path, animal):
    write_scans(tmp_path, animal, floor_m=8.0)
    subject = meshes.load("rex", request(tmp_path, scale="0.5"))
    np.testing.assert_allclose(subject.skeleton.joints_rest, 0.5 * animal.joints, atol=1e-6)
    assert any(line.startswith("scaled by 0.5 (data.scale): ") for line in subject.sources)


def test_bodies_are_measured_whole():
    """Also where they bend; hands, feet and head reach beyond the last joints."""
    subject = builtin_subject("50002")
    skeleton = subject.skeleton.to(torch.float64)
    for spec in subject.of_split("ood"):
        frame = spec.motion.num_frames // 2
        pose, shift = (torch.from_numpy(array[[frame]]) for array in (spec.motion.poses, spec.motion.translation))
        moved = skeleton.posed_from_rest(pose, shift)[0]
        joints = torch.einsum("jab,jb->ja", moved[:, :3, :3], skeleton.joints_rest) + moved[:, :3, 3]
        length, whole = subject_length(spec.meshes[frame][0], joints.numpy(), skeleton.parents)
        assert length == whole


def test_a_skeleton_elsewhere_or_of_one_joint_says_nothing():
    vertices = np.random.default_rng(0).random((50, 3)) * 4
    assert subject_length(vertices, np.zeros((1, 3)), (-1,)) == (np.ptp(vertices, axis=0).max(),) * 2
    far = np.array([[100.0, 0, 0], [101.0, 0, 0]])
    assert subject_length(vertices, far, (-1, 0))[0] == np.ptp(vertices, axis=0).max()
    joints = np.array([[0.0, 0, 0], [0, 1, 0]])
    assert near_bones(np.array([[0.2, 0.5, 0], [0.3, -0.2, 0], [0, 1.9, 0], [0, -0.3, 0]]), joints, (-1, 0)).tolist() == [
        True, False, True, False,
    ]  # fmt: skip


# ---------------------------------------------------------------- angles
def test_poses_in_degrees_are_a_problem(tmp_path, animal):
    write_scans(tmp_path, animal)
    path = tmp_path / "rex" / "walk" / "poses.npz"
    content = dict(np.load(path))
    np.savez(path, **content | {"poses": np.degrees(content["poses"])})
    subject = meshes.load("rex", request(tmp_path))
    assert "poses: wanted angles in radians, got degrees" in dict(subject.broken)["walk"]
    assert remarks(tmp_path)["broken"][0] == "problem"


def test_more_than_a_full_turn_is_a_warning(tmp_path, animal):
    write_scans(tmp_path, animal)
    path = tmp_path / "rex" / "walk" / "poses.npz"
    content = dict(np.load(path))
    content["poses"][1, 6] = 9.0
    np.savez(path, **content)
    (warning,) = meshes.load("rex", request(tmp_path)).warnings
    assert warning.startswith("walk: a joint ")
    assert "more than a full turn" in warning
    assert remarks(tmp_path)["check"][0] == "warning"


def test_a_canonical_pose_in_degrees_is_a_problem(tmp_path, animal):
    write_scans(tmp_path, animal)
    path = tmp_path / "rex" / "skeleton.npz"
    pose = np.zeros((19, 3))
    pose[7, 2] = 20.0
    np.savez(path, **dict(np.load(path)), canonical_pose=pose)
    with pytest.raises(UserError, match="canonical_pose: wanted angles in radians, got 20; save them in radians"):
        meshes.load("rex", request(tmp_path))


# ---------------------------------------------------------------- rigs
def test_a_clip_that_hides_a_part_is_left_out(tmp_path, animal):
    import json
    import struct

    content = animal_glb(animal, [animal_motion(name, FRAMES) for name in ("sit", "trot", "walk")])
    size = struct.unpack_from("<I", content, 12)[0]
    root, binary = json.loads(content[20 : 20 + size]), bytearray(content[28 + size :])
    clip = root["animations"][1]
    start = len(binary)
    binary += np.float32([[1, 1, 1], [0, 0, 0], [1, 1, 1]]).tobytes()
    root["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": 36})
    root["accessors"].append({"bufferView": len(root["bufferViews"]) - 1, "componentType": 5126, "count": 3, "type": "VEC3"})
    clip["samplers"].append({"input": clip["samplers"][0]["input"], "output": len(root["accessors"]) - 1})
    clip["channels"].append({"sampler": len(clip["samplers"]) - 1, "target": {"node": 4, "path": "scale"}})
    root["buffers"][0]["byteLength"] = len(binary)
    text = json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    (tmp_path / "rex.glb").write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
    subject = meshes.load("rex", request(tmp_path))
    assert [spec.name for spec in subject.sequences] == ["sit", "walk"]
    assert subject.warnings == (
        "motion trot was left out: joint 'head' has scale 0 in frame 1, so a part of the mesh vanishes",
    )
    assert remarks(tmp_path)["check"][0] == "warning"


def test_vrm_files_are_rigged_files(tmp_path):
    poses = a_pose() + np.random.default_rng(0).normal(0, 0.2, (10, 24, 3))
    (tmp_path / "rex.vrm").write_bytes(human_vrm(rig_of(poses, np.zeros((10, 3))), "VRMC_vrm").glb())
    subject = meshes.load("rex", request(tmp_path))
    assert subject.skeleton.num_joints == 24
    assert [spec.motion.num_frames for spec in subject.sequences] == [8, 2]
    (tmp_path / "rex.glb").write_bytes((tmp_path / "rex.vrm").read_bytes())
    with pytest.raises(UserError, match=r"has both rex\.glb and rex\.vrm; rename one of them"):
        subject_places(request(tmp_path))
