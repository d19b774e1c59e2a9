"""Joints of MHR from SAM 3D Body: limbs keep their directions, in every container that it is stored in."""

from __future__ import annotations

import logging
import pickle

import numpy as np
import pytest
import torch
from estimates import mhr_person, saved
from scipy.spatial.transform import Rotation

from snarfcli.bodies import SMPL_JOINT_NAMES
from snarfcli.errors import UserError
from snarfcli.formats.mhr import MhrTable
from snarfcli.motions import read_motion
from snarfcli.motions.anatomy import joint_positions

LIMBS = (
    ("l_hip", "l_knee", "l_upleg", "l_lowleg"), ("l_knee", "l_ankle", "l_lowleg", "l_foot"),
    ("r_hip", "r_knee", "r_upleg", "r_lowleg"), ("r_knee", "r_ankle", "r_lowleg", "r_foot"),
    ("l_shoulder", "l_elbow", "l_uparm", "l_lowarm"), ("l_elbow", "l_wrist", "l_lowarm", "l_wrist"),
    ("r_shoulder", "r_elbow", "r_uparm", "r_lowarm"), ("r_elbow", "r_wrist", "r_lowarm", "r_wrist"),
)  # fmt: skip


def turn(*degrees):
    return Rotation.from_euler("xyz", degrees, degrees=True)


POSED = {
    "root": turn(5, 70, 3), "l_upleg": turn(5, 10, -40), "l_lowleg": turn(0, 0, 80), "r_upleg": turn(10, 0, 20),
    "r_lowleg": turn(0, 0, 30), "c_spine1": turn(0, 5, 20), "l_uparm": turn(20, 30, 40), "l_lowarm": turn(0, 0, 70),
    "r_uparm": turn(-20, 10, -30), "r_lowarm": turn(0, 0, 40),
}  # fmt: skip


def check(motion, person, frame=0):
    """Check that the limbs point where those of the person do, after y was turned up."""
    table = MhrTable()
    numbers = dict(zip(table.names, table.numbers, strict=True))
    source = np.reshape(person["pred_joint_coords"], (-1, 127, 3))[0].astype(float) * [1, -1, -1]
    target = joint_positions(motion.poses, motion.translation)[0][frame]
    for upper, lower, start, end in LIMBS:
        ours = target[SMPL_JOINT_NAMES.index(lower)] - target[SMPL_JOINT_NAMES.index(upper)]
        theirs = source[numbers[end]] - source[numbers[start]]
        cosine = ours @ theirs / np.linalg.norm(ours) / np.linalg.norm(theirs)
        assert cosine > np.cos(np.radians(3)), (upper, np.degrees(np.arccos(cosine)))
    facing = Rotation.from_rotvec(motion.poses[frame, 0]).apply([0, 0, 1])
    wanted = np.reshape(person["pred_global_rots"], (-1, 127, 3, 3))[0, numbers["root"]] @ [0, 0, 1]
    assert facing @ wanted > np.cos(np.radians(20))  # the pelvis follows the spine of another body


@pytest.mark.parametrize("turns", [{}, POSED])
def test_limbs_keep_their_directions(tmp_path, caplog, turns):
    person = mhr_person(turns, frames=3)
    np.savez(tmp_path / "a.npz", **person)
    with caplog.at_level(logging.INFO, "snarfcli"):
        motion = read_motion(tmp_path / "a.npz")
    assert (motion.num_frames, motion.frame_rate, motion.name) == (3, 30, "a")
    check(motion, person)
    assert "y points down, as in the frame of a camera, and was turned up; up=y keeps it" in caplog.text
    assert -6 < motion.translation[0, 2] < -4  # in front of a camera that looks along -z
    assert Rotation.from_rotvec(read_motion(tmp_path / "a.npz", up="y").poses[0, 0]).apply([0, 1, 0])[1] < -0.9


def test_orientations_may_be_those_of_the_camera_or_of_a_world_with_y_up(tmp_path):
    person = mhr_person(POSED)
    half_turn = np.diag([1, -1, -1]).astype(np.float32)
    seen = {**person, "pred_global_rots": half_turn @ person["pred_global_rots"]}
    up = {
        **person,
        "pred_joint_coords": person["pred_joint_coords"] @ half_turn,
        "pred_cam_t": person["pred_cam_t"] @ half_turn,
    }
    wanted = None
    for arrays in (person, seen, up):
        np.savez(tmp_path / "a.npz", **arrays)
        motion = read_motion(tmp_path / "a.npz")
        wanted = motion if wanted is None else wanted
        np.testing.assert_allclose(motion.poses, wanted.poses, atol=1e-6)
        np.testing.assert_allclose(motion.translation, wanted.translation, atol=1e-6)


def test_a_handstand_stays_one(tmp_path, caplog):
    """Rotations with y up tell that the positions have y down, whatever the body does."""
    person = mhr_person(POSED)
    over = np.diag([-1, -1, 1]).astype(np.float32)  # by half a turn about the view, in the camera and in the world alike
    arrays = {**person, "pred_global_rots": over @ person["pred_global_rots"]}
    arrays |= {key: person[key] @ over for key in ("pred_joint_coords", "pred_cam_t")}
    np.savez(tmp_path / "a.npz", **arrays)
    with caplog.at_level("INFO", "snarfcli"):
        motion = read_motion(tmp_path / "a.npz")
    assert "y points down" in caplog.text
    np.savez(tmp_path / "b.npz", **person)
    wanted = Rotation.from_matrix(over) * Rotation.from_rotvec(read_motion(tmp_path / "b.npz").poses[:, 0])
    assert (wanted.inv() * Rotation.from_rotvec(motion.poses[:, 0])).magnitude().max() < 1e-5


def single(turns):
    return {key: value[0] for key, value in mhr_person(turns).items()}


def test_one_file_per_frame_and_lists_of_persons(tmp_path):
    persons = [single(POSED), single({})]
    (tmp_path / "frames").mkdir()
    for number in (0, 1, 10):
        np.savez(tmp_path / "frames" / f"{number}.npz", **persons[number % 2])
    motion = read_motion(tmp_path / "frames")
    assert motion.num_frames == 3
    check(motion, persons[0])
    check(motion, persons[1], frame=1)
    np.save(tmp_path / "persons.npy", np.array(persons, object))
    (tmp_path / "persons.pkl").write_bytes(pickle.dumps(persons))
    (tmp_path / "persons.pt").write_bytes(
        saved([{key: torch.from_numpy(array) for key, array in one.items()} for one in persons])
    )
    for name in ("persons.npy", "persons.pkl", "persons.pt"):
        check(read_motion(tmp_path / name), persons[0])
        check(read_motion(tmp_path / name, clip=1), persons[1])
    (tmp_path / "video.pkl").write_bytes(pickle.dumps([persons, persons[::-1], persons]))
    motion = read_motion(tmp_path / "video.pkl")
    assert motion.num_frames == 3
    check(motion, persons[1], frame=1)


def test_other_joints_by_mapping(tmp_path):
    np.savez(tmp_path / "a.npz", **mhr_person({"c_neck": turn(0, 0, 30)}))
    poses = read_motion(tmp_path / "a.npz", mapping={"neck": "c_neck", "l_ankle": None}).poses
    assert np.degrees(np.linalg.norm(poses[0, SMPL_JOINT_NAMES.index("neck")])) > 20
    assert not poses[0, SMPL_JOINT_NAMES.index("l_ankle")].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"pred_global_rots": np.zeros((126, 3, 3))},
            r"pred_global_rots: wanted shape \[frames, 127, 3, 3\], got \[126, 3, 3\]",
        ),
        (
            {"pred_joint_coords": np.zeros((2, 127, 3))},
            r"pred_joint_coords: wanted shape \[frames, 127, 3\], got \[2, 127, 3\]",
        ),
        ({"pred_joint_coords": np.full((127, 3), np.nan)}, "pred_joint_coords: wanted finite numbers"),
        ({"pred_global_rots": np.zeros((127, 3, 3))}, "pred_global_rots: wanted rotation matrices, got others"),
        ({"pred_joint_coords": np.zeros((127, 3))}, "wanted rotations that belong to the positions of the joints"),
        ({"pred_cam_t": np.zeros(2)}, r"pred_cam_t: wanted shape \[1, 3\], got \[1, 2\]"),
    ],
)
def test_what_does_not_fit(tmp_path, change, message):
    np.savez(tmp_path / "a.npz", **{**single({}), **change})
    with pytest.raises(UserError, match=message):
        read_motion(tmp_path / "a.npz")
    alone = single({})
    del alone["pred_joint_coords"]
    np.savez(tmp_path / "a.npz", **alone)
    with pytest.raises(UserError, match="wanted 'poses', got pred_cam_t, pred_global_rots, pred_keypoints_3d"):
        read_motion(tmp_path / "a.npz")


def test_the_right_side_mirrors_the_left():
    table = MhrTable()
    assert len(table.names) == len(set(table.names)) == 68
    assert table.parents[0] == -1
    assert all(parent < joint for joint, parent in enumerate(table.parents))
    np.testing.assert_allclose(table.rest @ table.rest.transpose(0, 2, 1), np.tile(np.eye(3), (68, 1, 1)), atol=1e-12)
    mirror = np.diag([-1, 1, 1])
    for left, name in enumerate(table.names):
        if name.startswith("l_"):
            right = table.names.index("r_" + name[2:])
            np.testing.assert_allclose(table.rest[right], -mirror @ table.rest[left])
            assert table.names[table.parents[right]].replace("r_", "l_", 1) == table.names[table.parents[left]]
