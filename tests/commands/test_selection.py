"""Selection of the frames of a motion, their frame rate, and in_place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton, legs_apart_pose
from snarfcli.commands import selection
from snarfcli.commands.selection import (
    AvatarSelection,
    MotionSelection,
    check_motion_selection,
    load_selected_avatar,
    select_motion,
)
from snarfcli.datasets.settings import DataConfig
from snarfcli.errors import UserError
from snarfcli.motions import Motion, read_motion
from snarfcli.motions.anatomy import JOINTS_REST, PARENTS

FRAMES, RATE = 25, 24.0
AVATAR = AvatarSelection("50002", DataConfig("builtin", 8, 1, 1), "data", "outputs", "fast_snarf", None, "cpu", None)
PLAIN = MotionSelection("auto", "rest", "auto", None, None, 0, 30.0, 0, None, 1, None, None, False)


@pytest.fixture(scope="module")
def skeleton() -> Skeleton:
    import torch

    rest = torch.from_numpy(JOINTS_REST).float()
    return Skeleton(SMPL_JOINT_NAMES, PARENTS, rest, legs_apart_pose(SMPL_JOINT_NAMES))


@pytest.fixture
def walk(tmp_path) -> str:
    """A body that turns about the vertical axis (0.5 turns per second) and walks (2 m/s)."""
    time = np.arange(FRAMES) / RATE
    poses = np.zeros((FRAMES, 72))
    poses[:, 1] = np.pi * time
    np.savez(tmp_path / "walk.npz", poses=poses, trans=np.stack([2 * time, 0.9 + 0 * time, 0 * time], 1), fps=RATE)
    return str(tmp_path / "walk.npz")


def choose(skeleton: Skeleton, pose: str, **changes):
    return select_motion(replace(PLAIN, up="y", **changes), AVATAR, skeleton, pose, None)


def test_frames_are_taken_as_asked_for(skeleton, walk):
    whole = read_motion(walk, skeleton, up="y")
    chosen = choose(skeleton, walk, start=3, stop=20, step=4, max_frames=3)
    assert chosen.numbers == [3, 7, 11]
    assert chosen.first == 3
    assert chosen.bone_transforms is None
    assert chosen.motion.frame_rate == RATE / 4
    np.testing.assert_array_equal(chosen.motion.poses, whole.poses[[3, 7, 11]])
    assert choose(skeleton, walk, start=-2).numbers == [FRAMES - 2, FRAMES - 1]


def test_resampling_keeps_the_pace(skeleton, walk):
    chosen = choose(skeleton, walk, start=4, stop=21, frame_rate=60.0)  # 16 intervals of 1/24 s are 2/3 s
    motion = chosen.motion
    assert motion.frame_rate == 60
    assert motion.num_frames == 41
    assert chosen.numbers == list(range(41))
    time = 4 / RATE + np.arange(41) / 60
    np.testing.assert_allclose(motion.poses[:, 0, 1], np.pi * time, atol=1e-9)
    np.testing.assert_allclose(motion.translation[:, 0], 2 * time, atol=1e-9)
    assert choose(skeleton, walk, frame_rate=60.0, max_frames=5).motion.num_frames == 5


def test_in_place_keeps_the_height_and_the_turns(skeleton, walk):
    chosen, free = choose(skeleton, walk, in_place=True), choose(skeleton, walk)
    np.testing.assert_allclose(chosen.motion.translation, np.tile([0, 0.9, 0], (FRAMES, 1)), atol=1e-12)
    np.testing.assert_array_equal(chosen.motion.poses, free.motion.poses)


def test_stretching_joints_are_kept_and_cannot_be_resampled(skeleton, monkeypatch):
    from snarfcli.commands.selection import stored_motion

    other = Skeleton(("a", "b"), (-1, 0), skeleton.joints_rest[:2], skeleton.joints_rest[:2] * 0)
    way = np.array([[0, 1, 0], [0.5, 1, 0.25], [1, 1, 0.5]])
    transforms = np.tile(np.eye(4, dtype=np.float32), (3, 2, 1, 1))
    transforms[:, :, :3, 3] = way[:, None]
    stretched = Motion("run", np.zeros((3, 2, 3)), way, 30.0)
    assert stored_motion.__module__ == "snarfcli.samples.stored_motion"
    monkeypatch.setattr(selection, "stored_motion", lambda *arguments: (stretched, transforms))
    own = replace(AVATAR, data=DataConfig("meshes", 1, 1, 1))
    chosen = select_motion(replace(PLAIN, start=1, in_place=True), own, other, None, None)
    np.testing.assert_allclose(chosen.bone_transforms[:, :, :3, 3], np.tile([0, 1, 0], (2, 2, 1)), atol=1e-7)
    assert transforms[2, 0, 0, 3] == 1  # the motion that was read is unchanged
    with pytest.raises(UserError, match="frame_rate: wanted a motion whose joints do not stretch, got run"):
        select_motion(replace(PLAIN, frame_rate=60.0), own, other, None, None)


def test_what_cannot_be_used_is_rejected(skeleton, walk):
    with pytest.raises(UserError, match="start=90, stop=null leave no frame; walk has frames 0 to 24"):
        choose(skeleton, walk, start=90)
    for changes, message in (
        ({"frame_rate": 0.0}, "frame_rate: wanted 1.0 to 1000.0, got 0.0"),
        ({"frame_rate": float("nan")}, "frame_rate: wanted 1.0 to 1000.0, got nan"),
        ({"step": 0}, "step: wanted at least 1, got 0"),
        ({"up": "w"}, "up: wanted auto, y, z, x, -y, -z or -x, got .w."),
    ):
        with pytest.raises(UserError, match=message):
            check_motion_selection(replace(PLAIN, **changes))


def test_an_avatar_gets_the_precision_of_the_command():
    path = Path(__file__).parents[1] / "golden" / "avatar.pt"
    choice = replace(AVATAR, ckpt=str(path))
    assert load_selected_avatar(choice)[0].precision == "high"
    assert load_selected_avatar(replace(choice, precision="bfloat16"))[0].precision == "bfloat16"
    with pytest.raises(UserError, match="precision: wanted highest, high, medium or bfloat16, got 'single'"):
        load_selected_avatar(replace(choice, precision="single"))
