"""Skeleton and pose files that users write by hand: what is accepted, and what is said about the rest."""

from __future__ import annotations

import json

import numpy as np
import pytest

from snarfcli.datasets.skeleton_files import DEFAULT_FRAME_RATE, read_poses, read_skeleton
from snarfcli.errors import UserError

SKELETON = {
    "names": ["hips", "head", "spine"],
    "parents": [None, "spine", "hips"],
    "joints_rest": [[0, 1, 0], [0, 2, 0], [0, 1.5, 0]],
}
THREE = np.arange(3)


def written(folder, content, name="skeleton.json"):
    path = folder / name
    if path.suffix == ".npz":
        np.savez(path, **content)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_joints_are_sorted_and_poses_follow(tmp_path):
    skeleton = read_skeleton(written(tmp_path, SKELETON))
    assert skeleton.names == ("hips", "spine", "head")
    assert skeleton.parents == (-1, 0, 1)
    assert skeleton.joints_rest[:, 1].tolist() == [1, 1.5, 2]
    assert (skeleton.canonical_pose, skeleton.up, skeleton.scale) == (None, None, None)
    poses = np.arange(18.0).reshape(2, 3, 3)
    path = written(tmp_path, {"poses": poses.tolist(), "fps": 50}, "poses.json")
    read = read_poses(path, skeleton.order)
    np.testing.assert_array_equal(read.poses, poses[:, [0, 2, 1]])
    assert (read.frame_rate, read.translation.tolist()) == (50, [[0, 0, 0]] * 2)


def test_an_npz_says_the_same_as_json(tmp_path):
    more = {"canonical_pose": np.eye(3).tolist(), "up": "z", "scale": 0.01}
    parents = {"parents": [-1, 2, 0]}
    one = read_skeleton(written(tmp_path, SKELETON | more | parents))
    arrays = {name: np.array(value) for name, value in (SKELETON | more | parents).items()}
    arrays["parents"] = np.array([2**32 - 1, 2, 0], np.uint32)  # SMPL's way to write -1
    other = read_skeleton(written(tmp_path, arrays, "skeleton.npz"))
    assert (one.names, one.parents, one.up, one.scale) == (other.names, other.parents, "z", 0.01)
    np.testing.assert_array_equal(one.canonical_pose, other.canonical_pose)
    np.testing.assert_array_equal(one.canonical_pose, np.eye(3)[[0, 2, 1]])


def test_names_may_be_left_out_and_there_may_be_several_roots(tmp_path):
    skeleton = read_skeleton(written(tmp_path, {"parents": [-1, -1], "joints": [[0, 0, 0], [1, 0, 0]]}))
    assert (skeleton.names, skeleton.parents) == (("joint_0", "joint_1"), (-1, -1))


def test_poses_may_be_folded_and_transforms_take_their_place(tmp_path):
    folded = read_poses(written(tmp_path, {"poses": np.ones((4, 9)), "trans": np.ones((4, 3))}, "poses.npz"), THREE)
    assert folded.poses.shape == (4, 3, 3)
    assert folded.num_frames == 4
    assert folded.frame_rate == DEFAULT_FRAME_RATE
    transforms = np.tile(np.eye(4), (5, 3, 1, 1))
    read = read_poses(written(tmp_path, {"bone_transforms": transforms, "frame_rate": 24}, "poses.npz"), THREE)
    assert read.poses is None
    assert read.num_frames == 5
    assert read.frame_rate == 24
    np.testing.assert_array_equal(read.posed_from_rest, transforms)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parents": None}, "has no parents; wanted names, parents and joints_rest"),
        ({"joints_rest": None}, "has no joints_rest"),
        ({"parents": []}, "parents: wanted a list of 1 to 1000 joints"),
        ({"parents": [None, "spin", "hips"]}, "wanted names, numbers from 0 to 2, or -1 for a root, got 'spin'"),
        ({"parents": [-1, 3, 0]}, "for a root, got 3"),
        ({"parents": [-1, 2, 1]}, "form a circle"),
        ({"parents": [True, 0, 0]}, "for a root, got True"),
        ({"names": ["a", "b"]}, "names: wanted 3 texts"),
        ({"names": ["a", "b", "a"]}, "wanted each name once, got 'a' twice"),
        ({"names": ["a", "b", "c\n"]}, "wanted texts of 1 to 100 letters"),
        ({"joints_rest": [[0, 1, 0], [0, 2, 0]]}, "joints_rest: wanted shape 3x3, got 2x3"),
        ({"joints_rest": [[0, 1, 0], [0, 2], [0, 1, 0]]}, "joints_rest: wanted 3x3 numbers"),
        ({"joints_rest": [[0, 1, 0], [0, 2, "1"], [0, 1, 0]]}, "joints_rest: wanted 3x3 numbers"),
        ({"joints_rest": [[0, 1, 0], [0, 2, float("nan")], [0, 1, 0]]}, "joints_rest: wanted finite numbers"),
        ({"joints_rest": [[0, 1, 0], [0, 2, 10**400], [0, 1, 0]]}, "joints_rest: wanted 3x3 numbers"),
        ({"up": "x"}, "up: wanted y or z"),
        ({"up": 3}, "up: wanted a text"),
        ({"scale": 0}, "scale: wanted a positive number"),
    ],
)
def test_a_broken_skeleton_is_named(tmp_path, changes, message):
    with pytest.raises(UserError, match=message) as error:
        read_skeleton(written(tmp_path, SKELETON | changes))
    assert "skeleton.json" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "has neither poses nor bone_transforms"),
        ({"poses": np.zeros((2, 4, 3))}, "poses: wanted shape Tx3x3, got 2x4x3"),
        ({"poses": np.zeros((2, 8))}, "poses: wanted shape Tx3x3, got 2x8"),
        ({"poses": np.zeros((0, 9))}, "wanted at least 1 frame, got 0"),
        ({"poses": np.zeros((2, 9)), "trans": np.zeros((3, 3))}, "trans: wanted 2 rows, one per pose, got 3"),
        ({"poses": np.full((2, 9), np.nan)}, "poses: wanted finite numbers .*, got NaN, infinity or larger ones in frame 0"),
        ({"poses": np.zeros((2, 9)), "fps": 0}, "frame_rate: wanted a positive number"),
        ({"poses": np.array([["a"]])}, "poses: wanted Tx3x3 numbers"),
        ({"bone_transforms": np.zeros((2, 3, 4, 4))}, "wanted last rows 0 0 0 1, got others; transpose them"),
        ({"bone_transforms": np.zeros((2, 3, 3, 3))}, "bone_transforms: wanted shape Tx3x4x4, got 2x3x3x3"),
    ],
)
def test_broken_poses_are_named(tmp_path, content, message):
    with pytest.raises(UserError, match=message) as error:
        read_poses(written(tmp_path, content, "poses.npz"), THREE)
    assert "poses.npz" in str(error.value)


@pytest.mark.parametrize("content", ["", "[1]", "{", "[" * 100_000, '{"parents": ' + "1" * 5000 + "}"])
def test_what_is_no_json_is_said_to_be_none(tmp_path, content):
    with pytest.raises(UserError, match=r"skeleton.json: is not"):
        read_skeleton(written(tmp_path, content))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match=r"no skeleton file at .*skeleton.json"):
        read_skeleton(tmp_path / "skeleton.json")
