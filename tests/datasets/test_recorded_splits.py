"""Which sequences of `data=meshes` are held out: motion that differs from that of training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from toy_animal import Animal, AnimalMotion, animal_motion, make_animal
from toy_animal_files import animal_glb, write_animal_meshes

from snarfcli.datasets import meshes
from snarfcli.datasets.alike import find_twins, is_named_rest, is_still, pose_points
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.datasets.splits import split_sequences
from snarfcli.datasets.subjects import SubjectData

FRAMES = 8


@pytest.fixture(scope="module")
def animal() -> Animal:
    return make_animal(0.2)


def loaded(folder: Path, animal: Animal, motions: list[AnimalMotion], *, as_rig: bool = True, **settings) -> SubjectData:
    if as_rig:
        (folder / "rex.glb").write_bytes(animal_glb(animal, motions))
    else:
        write_animal_meshes(folder / "rex", animal, motions)
    return meshes.load("rex", Request(DataConfig("meshes", 1, 1, 1, folder=str(folder), **settings), Path("nowhere")))


def splits_of(subject: SubjectData) -> dict[str, str]:
    return {spec.name: spec.split for spec in subject.sequences}


def standing(name: str, frames: int = FRAMES, angle: float = 0.0) -> AnimalMotion:
    poses = np.zeros((frames, 19, 3))
    poses[:, 3:6, 0] = angle
    return AnimalMotion(name, poses, np.zeros((frames, 3)))


def along(motion: AnimalMotion, name: str) -> AnimalMotion:
    """The same poses on a curved way through the world."""
    turns = Rotation.from_euler("y", np.linspace([0], [1.2], len(motion.poses)))
    poses = motion.poses.copy()
    poses[:, 0] = (turns * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    way = motion.translation + np.linspace([0, 0, 0], [0.3, 0, 2.0], len(poses))
    return AnimalMotion(name, poses, way)


@pytest.mark.parametrize("as_rig", [True, False])
def test_a_rest_pose_is_for_training(tmp_path, animal, as_rig):
    motions = [animal_motion(name, FRAMES) for name in ("sit", "trot")]
    subject = loaded(tmp_path, animal, [*motions, standing("zzz"), standing("zzz_bent", angle=0.5)], as_rig=as_rig)
    assert splits_of(subject) == {"sit": "train", "zzz": "train", "zzz_bent": "train", "trot": "test"}
    line = "for training, as they show one pose only: zzz, zzz_bent; data.test=[NAME] holds out others"
    assert line in subject.sources
    assert not subject.warnings


def test_a_pattern_may_hold_out_a_rest_pose(tmp_path, animal):
    subject = loaded(tmp_path, animal, [animal_motion("sit", FRAMES), standing("bind")], test=["bind"])
    assert splits_of(subject) == {"sit": "train", "bind": "test"}


@pytest.mark.parametrize("as_rig", [True, False])
def test_twins_share_a_split(tmp_path, animal, as_rig):
    motions = [animal_motion(name, FRAMES) for name in ("sit", "sniff", "trot", "walk")]
    subject = loaded(tmp_path, animal, [*motions, along(motions[3], "walk_RM")], as_rig=as_rig)
    assert splits_of(subject) == {"sit": "train", "sniff": "train", "trot": "train", "walk": "test", "walk_RM": "test"}
    assert "walk, walk_RM show the same poses, so they share a split" in subject.sources


def test_twins_in_different_splits_by_pattern_are_a_warning(tmp_path, animal):
    walk = animal_motion("walk", FRAMES)
    subject = loaded(tmp_path, animal, [walk, along(walk, "walk_RM"), animal_motion("sit", FRAMES)], test=["walk"])
    assert splits_of(subject) == {"sit": "train", "walk_RM": "train", "walk": "test"}
    (warning,) = subject.warnings
    assert warning.startswith("walk, walk_RM show the same poses, but are in different splits")


def test_the_end_of_the_only_motion_is_held_out_from_all_its_twins(tmp_path, animal):
    walk = animal_motion("walk", FRAMES)
    subject = loaded(tmp_path, animal, [walk, along(walk, "walk_RM"), standing("T-Pose")])
    assert splits_of(subject) == {
        "T-Pose": "train", "walk": "train", "walk_RM": "train", "walk_end": "test", "walk_RM_end": "test",
    }  # fmt: skip
    counts = {spec.name: spec.motion.num_frames for spec in subject.sequences}
    assert counts["walk"] + counts["walk_end"] == FRAMES


def test_single_frames_are_not_still(tmp_path, animal):
    poses = [standing(name, 1, 0.2 * number) for number, name in enumerate("abcd")]
    assert splits_of(loaded(tmp_path, animal, poses[1:])) == {"b": "train", "c": "train", "d": "test"}


def test_if_nothing_moves_other_poses_are_held_out(tmp_path, animal):
    poses = [standing(name, 3, 0.2 * number) for number, name in enumerate("abcd")]
    assert splits_of(loaded(tmp_path, animal, poses)) == {"a": "train", "b": "train", "c": "train", "d": "test"}


@pytest.mark.parametrize(
    ("name", "expected"),
    [("Rest_Pose", True), ("rest", True), ("TPose", True), ("T-Pose", True), ("a pose", True), ("Armature|Bind_Pose", True),
     ("RestPose_02", True), ("fox_rest_pose", True), ("bind", True), ("Walk", False), ("walk_to_rest", False),
     ("Resting", False), ("Interest", False), ("Pose", False), ("Fall", False), ("panda pose", False), ("", False),
     ("Dance_A_Pose", False), ("Take_a_pose", False)],
)  # fmt: skip
def test_names_of_rest_poses(name, expected):
    assert is_named_rest(name) == expected


# ---------------------------------------------------------------- poses compared
PARENTS = (-1, 0, 1, 2, 1, 4, 1)
REST = np.array([[0, 0, 0], [0, 1, 0], [0.3, 1, 0], [0.6, 1, 0], [-0.3, 1, 0], [-0.6, 1, 0], [0, 1.5, 0]])


def moved(angles: np.ndarray, way: np.ndarray, mover: int) -> np.ndarray:
    """Bone transforms of a body whose joint `mover` (the root, or the hips below it) goes through the world."""
    import torch

    from snarfcli.bodies import forward_kinematics

    poses = np.zeros((len(angles), len(PARENTS), 3))
    poses[:, 2:, 2] = angles
    poses[:, mover, 1] = way
    result = forward_kinematics(torch.from_numpy(poses), torch.from_numpy(REST), PARENTS, torch.zeros(len(poses), 3))[1].numpy()
    result[:, mover:, :3, 3] += way[:, None, None] * np.array([0.5, 0, 1.0])
    return result


def test_poses_are_compared_whatever_moves_through_the_world():
    angles = np.cumsum(np.random.default_rng(1).normal(0, 0.2, (20, 5)), 0)
    way = np.linspace(0, 2, 20)
    points = {
        "in place": pose_points(moved(angles, 0 * way, 0), REST, PARENTS),
        "root": pose_points(moved(angles, way, 0), REST, PARENTS),
        "hips": pose_points(moved(angles, way, 1), REST, PARENTS),
        "slow": pose_points(moved(angles[::2], way[::2] * 0, 0), REST, PARENTS),
        "other": pose_points(moved(angles[:, ::-1], way, 0), REST, PARENTS),
    }
    np.testing.assert_allclose(points["in place"], points["root"], atol=1e-5)
    np.testing.assert_allclose(points["in place"], points["hips"], atol=1e-5)
    assert find_twins(points) == [["in place", "root", "hips", "slow"]]
    assert not any(is_still(values) for values in points.values())
    assert is_still(pose_points(moved(0 * angles + 0.3, way, 1), REST, PARENTS))
    assert find_twins({}) == []


def test_one_turned_head_tells_poses_apart():
    angles = np.zeros((6, 5))
    turned = angles.copy()
    turned[:, 4] = np.linspace(0, 0.3, 6)
    one, other = (pose_points(moved(values, np.zeros(6), 0), REST, PARENTS) for values in (angles, turned))
    assert is_still(one)
    assert not is_still(other)


def test_groups_count_as_one_sequence():
    names = [f"s{number}" for number in range(6)]
    assert split_sequences(names, [], [], alike=[["s1", "s5"]]) == dict.fromkeys(names, "train") | {"s4": "test"}
    alike = [["s4", "s5"], ["s0", "s1"]]
    assert [name for name, split in split_sequences(names, [], [], alike=alike).items() if split == "test"] == ["s4", "s5"]
    still = (["s5"], ["s4"])
    assert [name for name, split in split_sequences(names, [], [], still=still).items() if split == "test"] == ["s3"]
    assert "test" not in split_sequences(names[:2], [], [], alike=[["s0", "s1"]]).values()
