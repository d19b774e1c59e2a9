"""Results of video estimators: several persons, frames as dictionaries, world and camera, in every container."""

from __future__ import annotations

import logging
import pickle

import numpy as np
import pytest
import torch
from estimates import camera_poses, gvhmr, saved, wham
from scipy.spatial.transform import Rotation

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError
from snarfcli.motions import builtin_motion, read_motion
from snarfcli.motions.anatomy import JOINTS_REST
from snarfcli.motions.layouts import SMPL_X
from snarfcli.motions.pose_keys import is_of_camera, role_of

OURS = builtin_motion("hips", 1, frame_rate=30.0).slice(0, 6)
POSES = OURS.poses.copy()
POSES[:, 22:] = 0
FLAT = POSES.reshape(6, 72)
SEEN = camera_poses(POSES)
FAR = np.tile([0.0, 0.0, 3.0], (6, 1))


def matrices(poses):
    return Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)


def check(motion, *, atol=1e-9):
    """Check that the motion has our poses and stands upright."""
    turns = Rotation.from_rotvec(motion.poses.reshape(-1, 3))
    wanted = Rotation.from_rotvec(POSES[: motion.num_frames].reshape(-1, 3))
    np.testing.assert_allclose((turns.inv() * wanted).magnitude(), 0, atol=atol)


def test_gvhmr_takes_the_world_and_says_what_else_there_is(tmp_path, caplog):
    path = tmp_path / "hmr4d_results.pt"
    for is_zip in (True, False):
        path.write_bytes(saved(gvhmr(POSES, OURS.translation), is_zip=is_zip))
        with caplog.at_level(logging.INFO, "snarfcli"):
            motion = read_motion(path)
        check(motion, atol=1e-6)
        np.testing.assert_allclose(motion.translation, OURS.translation, atol=1e-6)
        assert motion.frame_rate == 30
        assert motion.name == "hmr4d_results_smpl_params_global"
    assert "motion 0 of 3 is used; others by clip=NAME or number (0: smpl_params_global, 1: net_outputs/pred_" in caplog.text
    assert "2: smpl_params_incam)" in caplog.text
    assert "head down" not in caplog.text
    for clip in ("smpl_params_incam", 2, "2"):
        with caplog.at_level(logging.INFO, "snarfcli"):
            motion = read_motion(path, clip=clip)
        check(motion, atol=1e-6)
        # 4 m away, in front of a camera that looks along -z after y was turned up
        np.testing.assert_allclose(motion.translation[:, 2] + 2 * JOINTS_REST[0, 2], -4, atol=1e-6)
    assert "y was taken to point down; up=y keeps it" in caplog.text
    assert Rotation.from_rotvec(read_motion(path, clip=2, up="y").poses[:, 0]).apply([0, 1, 0])[:, 1].max() < -0.9
    with pytest.raises(UserError, match=r"has no motion 'smpl_params_globe'; did you mean 'smpl_params_global'\?"):
        read_motion(path, clip="smpl_params_globe")


def test_wham_takes_the_first_person_in_the_world(tmp_path):
    other = wham(camera_poses(SEEN[:, ::-1].copy() * 0), OURS.translation)
    path = tmp_path / "wham_output.pkl"
    path.write_bytes(pickle.dumps({0: wham(POSES, OURS.translation), 3: other}))
    motion = read_motion(path)
    check(motion)
    np.testing.assert_array_equal(motion.translation, OURS.translation)
    assert motion.name == "wham_output_0_world"
    check(read_motion(path, clip="0/camera"))
    np.testing.assert_allclose(read_motion(path, clip="3/world").poses, 0, atol=1e-12)


def test_pictures_of_4d_humans_are_joined_by_person(tmp_path, caplog):
    frames = {}
    for number, turns in enumerate(matrices(SEEN)):
        one = {"global_orient": turns[:1], "body_pose": turns[1:], "betas": np.zeros(10)}
        still = {"global_orient": turns[:1], "body_pose": np.tile(np.eye(3), (23, 1, 1)), "betas": np.zeros(10)}
        people = [(4, one), (7, still)] if number != 2 else [(4, one)]
        people = people[::-1] if number == 3 else people
        frames[f"img/{number:06}.jpg"] = {"tid": [key for key, _ in people], "smpl": [each for _, each in people]}
    path = tmp_path / "demo.pkl"
    path.write_bytes(pickle.dumps(frames))
    motion = read_motion(path)
    check(motion)
    assert (motion.num_frames, motion.frame_rate, motion.name) == (6, 30, "demo_smpl_person_4")
    with caplog.at_level(logging.INFO, "snarfcli"):
        assert read_motion(path, clip="smpl/person 7").num_frames == 5
    assert "frames without this person were left out: 1" in caplog.text


def test_romp_has_persons_where_others_have_frames(tmp_path):
    def picture(number):
        return {
            "smpl_thetas": np.stack([SEEN[number].ravel(), np.zeros(72)]), "cam_trans": FAR[:2], "cam": np.zeros((2, 3)),
            "center_confs": np.ones(2), "body_pose": np.zeros((2, 69)), "global_orient": np.zeros((2, 3)),
        }  # fmt: skip

    np.savez(tmp_path / "video_results.npz", results=np.array({f"{n:08}.png": picture(n) for n in range(6)}, object))
    motion = read_motion(tmp_path / "video_results.npz")
    check(motion)
    assert motion.num_frames == 6
    np.savez(tmp_path / "one.npz", results=np.array(picture(1), object))
    assert read_motion(tmp_path / "one.npz").num_frames == 1
    assert not read_motion(tmp_path / "one.npz", clip=1, up="y").poses.any()


def save_npz(tmp_path, **arrays):
    np.savez(tmp_path / "a.npz", **arrays)
    return tmp_path / "a.npz"


@pytest.mark.parametrize(
    "arrays",
    [
        {"global_orient": FLAT[:, :3], "body_pose": FLAT[:, 3:]},
        {"global_orient": POSES[:, :1], "body_pose": POSES[:, 1:]},
        {"global_orient": FLAT[:, :3], "body_pose": FLAT[:, 3:66]},
        {"global_orient": matrices(POSES)[:, :1], "body_pose": matrices(POSES)[:, 1:]},
        {"global_orient": matrices(POSES)[:, 0], "body_pose": matrices(POSES)[:, 1:22]},
        {"pred_rotmat": matrices(POSES)},
        {"root_orient": FLAT[None, :, :3], "pose_body": FLAT[None, :, 3:66], "cam_R": np.eye(3)},
        {"poses": FLAT[None]},
        {"poses": POSES[None]},
        {"poses": matrices(POSES)[None]},
        {"poses_root": FLAT[:, :3], "poses_body": FLAT[:, 3:]},
        {"pose": np.zeros((6, 72)), "pose_world": FLAT},
    ],
)
def test_shapes_of_parts_and_poses(tmp_path, arrays):
    check(read_motion(save_npz(tmp_path, **arrays)))


@pytest.mark.parametrize(
    "arrays",
    [
        {"global_orient": FLAT[0, :3], "body_pose": FLAT[0, 3:]},
        {"global_orient": POSES[0, 0], "body_pose": POSES[0, 1:]},
        {"global_orient": matrices(POSES)[0, 0], "body_pose": matrices(POSES)[0, 1:22]},
        {"global_orient": matrices(POSES)[:1, :1], "body_pose": matrices(POSES)[:1, 1:]},
        {"poses": matrices(POSES)[0]},
        {"smpl": np.array({"global_orient": FLAT[0, :3], "body_pose": FLAT[0, 3:]}, object)},
    ],
)
def test_one_frame_without_its_axis(tmp_path, arrays):
    motion = read_motion(save_npz(tmp_path, **arrays))
    assert motion.num_frames == 1
    check(motion)


def test_fingers_and_face_of_smplx(tmp_path, caplog):
    rng = np.random.default_rng(0)
    left, right, jaw = 0.3 * rng.normal(size=(6, 45)), 0.3 * rng.normal(size=(6, 15, 3)), 0.1 * rng.normal(size=(6, 3))
    arrays = {"global_orient": FLAT[:, :3], "body_pose": FLAT[:, 3:66], "jaw_pose": jaw, "leye_pose": 2 * jaw}
    skeleton = smplx_like()
    path = save_npz(tmp_path, **arrays, left_hand_pose=left, right_hand_pose=right, reye_pose=3 * jaw)
    poses = read_motion(path, skeleton).poses
    np.testing.assert_allclose(poses[:, :22], POSES[:, :22])
    np.testing.assert_allclose(poses[:, 22:25], np.stack([jaw, 2 * jaw, 3 * jaw], 1))
    np.testing.assert_allclose(poses[:, 25:], np.concatenate([left.reshape(6, 15, 3), right], 1))
    with caplog.at_level(logging.INFO, "snarfcli"):
        poses = read_motion(save_npz(tmp_path, **arrays, left_hand_pose=left[:, :6]), skeleton).poses
    assert "left_hand_pose: principal components of hands need a body model; hands stay at rest" in caplog.text
    np.testing.assert_array_equal(poses[:, 25:], 0)


def smplx_like():
    parents = (-1, *(max(0, joint // 2) for joint in range(1, 55)))  # any tree: only names count
    return Skeleton(SMPL_X, parents, torch.zeros(55, 3), torch.zeros(55, 3))


@pytest.mark.parametrize("width", [156, 165])
def test_fullpose_is_that_of_amass(tmp_path, width):
    full = np.zeros((6, width))
    full[:, :66] = FLAT[:, :66]
    full[:, :3] = (Rotation.from_euler("x", 90, degrees=True) * Rotation.from_rotvec(FLAT[:, :3])).as_rotvec()
    check(read_motion(save_npz(tmp_path, fullpose=full, trans=FAR)))


def test_persons_of_lists_and_axes(tmp_path):
    path = tmp_path / "actors.pkl"
    path.write_bytes(pickle.dumps({"poses": [FLAT, 0 * FLAT], "trans": [OURS.translation, FAR], "fps": 25}))
    motion = read_motion(path)
    check(motion)
    np.testing.assert_array_equal(motion.translation, OURS.translation)
    assert motion.frame_rate == 25
    np.testing.assert_array_equal(read_motion(path, clip=1, up="y").translation, FAR)
    two = save_npz(tmp_path, poses=np.stack([FLAT, 0 * FLAT]), trans=np.stack([OURS.translation, FAR]), fps=25.0)
    check(read_motion(two))
    path.write_bytes(pickle.dumps({"poses": FLAT.tolist(), "trans": OURS.translation.tolist()}))
    check(read_motion(path))
    path.write_bytes(pickle.dumps({"poses": list(FLAT)}))
    check(read_motion(path))


def test_bodies_that_are_placed_as_a_whole(tmp_path):
    """EasyMocap rotates the posed body about the origin, not about its root; ZJU-MoCap has a file per frame."""
    (tmp_path / "zju").mkdir()
    rotation = Rotation.from_rotvec(FLAT[:, :3])
    way = OURS.translation + JOINTS_REST[0] - rotation.apply(JOINTS_REST[0])
    for number in range(6):
        bent = FLAT[number].copy()
        bent[:3] = 0
        frame = {"poses": bent[None], "Rh": FLAT[None, number, :3], "Th": way[None, number], "shapes": np.zeros((1, 10))}
        np.save(tmp_path / "zju" / f"{number}.npy", np.array(frame, object))
    motion = read_motion(tmp_path / "zju")
    check(motion)
    np.testing.assert_allclose(motion.translation, OURS.translation, atol=1e-12)


def test_frames_in_files_of_other_formats(tmp_path):
    (tmp_path / "frames").mkdir()
    for number in (0, 1, 10, 2):
        content = {"global_orient": torch.from_numpy(FLAT[number % 6, :3]), "body_pose": torch.from_numpy(FLAT[number % 6, 3:])}
        (tmp_path / "frames" / f"{number}.pt").write_bytes(saved(content))
    motion = read_motion(tmp_path / "frames")
    np.testing.assert_allclose(motion.poses, POSES[[0, 1, 2, 4]])


def test_arrays_that_are_not_needed_do_not_matter(tmp_path):
    odd = {"verts": np.array([open], object), "gender": np.array("male", object), "name": np.array([{}], object)}
    check(read_motion(save_npz(tmp_path, poses=FLAT, **odd)))
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"poses": FLAT, "trans": OURS.translation, "cfg": open, "n": [Rotation]}))
    check(read_motion(tmp_path / "a.pkl"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"faces": np.zeros(3), "deep": {"verts": np.zeros(3)}},
            "wanted 'poses', got deep, faces, verts; give a file with poses",
        ),
        ({"global_orient": FLAT[:, :3]}, "wanted 'poses', got global_orient"),
        ({"global_orient": FLAT[:2, :3], "body_pose": FLAT[:, 3:]}, r"global_orient: wanted shape \[6, 3\], got \[2, 3\]"),
        ({"global_orient": FLAT[:, :3], "body_pose": FLAT[:, :60]}, r"body_pose: wanted shape \[6, 63\], got \[6, 60\]"),
        ({"global_orient": FLAT[:, :3], "body_pose": matrices(POSES)[:, 1:] * 2}, "body_pose: wanted rotation matrices"),
        ({"global_orient": "x", "body_pose": FLAT[:, 3:]}, "global_orient: wanted an array, got str"),
        ({"poses": [FLAT[0], FLAT[1, :71]]}, "poses: wanted arrays of one size in all frames"),
        ({"poses": FLAT, "Rh": FLAT[:2, :3], "Th": FAR}, r"Rh, Th: wanted shape \[6, 3\], got \[2, 3\] and \[6, 3\]"),
        ({"poses": FLAT, "fps": "fast"}, "fps: wanted one positive number"),
    ],
)
def test_what_does_not_fit(tmp_path, content, message):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(content))
    with pytest.raises(UserError, match=message) as caught:
        read_motion(path)
    assert str(caught.value).isprintable()
    assert str(path) in str(caught.value)


def test_names_in_labels_are_printable_and_no_paths(tmp_path):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps({"../\x1b[2J": {"poses": FLAT}, "b": {"poses": FLAT}}))
    name = read_motion(path).name
    assert name == "a_.._2J"
    with pytest.raises(UserError) as caught:
        read_motion(path, clip="c")
    assert str(caught.value).isprintable()


def test_shared_arrays_do_not_grow(tmp_path):
    frame = np.zeros((1, 2**20))
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps({"poses": [frame[0]] * 5000}))
    with pytest.raises(UserError, match="poses: wanted at most 16777216 values, got 5242880000"):
        read_motion(path)


def test_lists_that_repeat_others_do_not_grow(tmp_path):
    numbers = [0.5]
    for _ in range(20):
        numbers = [numbers, numbers]
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps({"poses": numbers, "trans": numbers}))
    with pytest.raises(UserError, match="poses: wanted an array, got list"):
        read_motion(path)


def test_names_and_their_roles():
    assert role_of("poses") == ("poses", "", 0)
    assert role_of("pose_world")[:2] == ("poses", "world")
    assert role_of("smplx_body_pose")[:2] == ("body", "")
    assert role_of("pred_cam_t")[:2] == ("trans", "")
    assert role_of("trans_cam")[:2] == ("trans", "camera")
    for name in ("betas", "pose_2d", "verts", "pred_cam", 7, None, "x" * 10**6):
        assert role_of(name) is None
    assert is_of_camera(["betas", "pred_cam"])
    assert is_of_camera(["focal_length"])
    assert not is_of_camera(["betas", "campaign", "mocap_framerate", 3])
