"""Motion files of every format: equal motions from each, and a one-line error for each kind of damage."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from pose_files import TWO_JOINTS, amass_arrays, save
from scipy.spatial.transform import Rotation

from snarfcli.errors import UserError
from snarfcli.motions import builtin_motion, read_motion


def test_bad_files(tmp_path):
    path = save(tmp_path, **amass_arrays(frames=50))
    content = path.read_bytes()
    for name, written, message in (
        ("truncated", content[: len(content) // 2], "truncated"),
        ("text", b"poses, trans\n", "not an .npz archive"),
        ("empty", b"", "not an .npz archive"),
        ("flipped", content[:900] + bytes(400) + content[1300:], "cannot be read|damaged"),
    ):
        broken = tmp_path / f"{name}.npz"
        broken.write_bytes(written)
        with pytest.raises(UserError, match=message) as caught:
            read_motion(broken)
        assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="no pose file at"):
        read_motion(tmp_path / "none.npz")
    for name, message in (("walk.fbx", "wanted a file ending in .npz, .npy"), ("none", "no pose file at")):
        (tmp_path / "walk.fbx").touch()
        with pytest.raises(UserError, match=message):
            read_motion(tmp_path / name)


def test_wrong_arguments(tmp_path):
    with pytest.raises(ValueError, match="up: wanted one of auto, y, z, x, -y, -z, -x, got 'w'"):
        read_motion(tmp_path / "a.npz", up="w")
    with pytest.raises(ValueError, match="hands: wanted 'rest' or 'released', got 'fists'"):
        read_motion(tmp_path / "a.npz", hands="fists")
    with pytest.raises(UserError, match=r"wanted 6 values per frame, got 72"):
        read_motion(save(tmp_path, poses=np.zeros((1, 72))), TWO_JOINTS)


def test_equal_samples_through_every_route(tmp_path):
    """One motion as AMASS old and new, its parts alone, plain arrays, AIST++ and a folder of frames."""
    ours = builtin_motion("hips", 1, frame_rate=60.0).slice(0, 12)
    body = ours.poses.copy()
    body[:, 22:] = 0  # SMPL-H has no such joints
    turn = Rotation.from_euler("x", 90, degrees=True)
    rest = np.array([0.0, -0.22, 0.03])  # SMPL's pelvis
    z_up = body.copy()
    z_up[:, 0] = (turn * Rotation.from_rotvec(z_up[:, 0])).as_rotvec()
    way = turn.apply(ours.translation + rest) - rest
    fingers = np.random.default_rng(0).normal(size=(12, 90))
    flat = z_up[:, :22].reshape(12, 66)
    parts = {"root_orient": flat[:, :3], "pose_body": flat[:, 3:66], "pose_hand": fingers}
    np.savez(tmp_path / "old_poses.npz", poses=np.hstack([flat, fingers]), trans=way, mocap_framerate=60.0,
             gender=np.array(b"male"), betas=np.zeros(16), dmpls=np.zeros((12, 8)))  # fmt: skip
    np.savez(tmp_path / "new_stageii.npz", poses=np.hstack([flat, np.zeros((12, 9)), fingers]), trans=way, gender="male",
             mocap_frame_rate=60.0, surface_model_type="smplx", **parts)  # fmt: skip
    np.savez_compressed(tmp_path / "parts.npz", trans=way, mocap_frame_rate=60.0, **parts)
    np.savez(tmp_path / "plain.npz", pose=body.reshape(12, 72), transl=ours.translation, fps=60)
    np.savez(tmp_path / "joints.npz", poses=body, trans=ours.translation, frame_rate=60)
    matrices = Rotation.from_rotvec(body.reshape(-1, 3)).as_matrix().reshape(12, 24, 3, 3)
    np.savez(tmp_path / "matrices.npz", poses=matrices, trans=ours.translation)
    aist = {"smpl_poses": body.reshape(12, 72), "smpl_trans": 93.5 * ours.translation, "smpl_scaling": np.array([93.5])}
    (tmp_path / "gBR_sBM.pkl").write_bytes(pickle.dumps({**aist, "smpl_loss": 0.5}, protocol=2))
    (tmp_path / "frames").mkdir()
    for frame in range(12):
        np.savez(tmp_path / "frames" / f"dance.{frame + 1}.npz", pose=body[frame].ravel(), transl=ours.translation[frame])
    np.savez(tmp_path / "frames" / "._dance.1.npz", x=1)
    for name in ("old_poses.npz", "new_stageii.npz", "parts.npz", "plain.npz", "joints.npz", "matrices.npz", "frames",
                 "gBR_sBM.pkl"):  # fmt: skip
        motion = read_motion(tmp_path / name)
        assert motion.name == name.split(".")[0]
        assert motion.frame_rate == 60
        np.testing.assert_allclose(motion.poses, body, atol=1e-12, err_msg=name)
        np.testing.assert_allclose(motion.translation, ours.translation, atol=1e-12, err_msg=name)
    np.save(tmp_path / "plain.npy", body.reshape(12, 72).astype(np.float32))
    alone = read_motion(tmp_path / "plain.npy")
    np.testing.assert_allclose(alone.poses, body, atol=1e-6)
    np.testing.assert_array_equal(alone.translation, 0)


def test_folders_that_are_no_frames(tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    with pytest.raises(
        UserError, match=r"frames has no files ending in .npz, .npy, .*; give a pose file, or a folder with one per frame"
    ):
        read_motion(folder)
    np.savez(folder / "a_2.npz", pose=np.zeros(72), transl=np.zeros(3))
    np.savez(folder / "a_10.npz", pose=np.zeros(72))
    with pytest.raises(UserError, match=r"a_10.npz: trans is missing or has another shape"):
        read_motion(folder)
    np.savez(folder / "a_10.npz", v_posed=np.zeros((5, 3)))
    with pytest.raises(UserError, match=r"a_10.npz has no 'pose'; add it to every .npz file"):
        read_motion(folder)
    np.savez(folder / "a_10.npz", pose=np.full(72, np.nan))
    with pytest.raises(UserError, match=r"a_10.npz: pose: wanted finite numbers"):
        read_motion(folder)
    np.savez(folder / "a_10.npz", poses=np.zeros((5, 156)))
    with pytest.raises(UserError, match=r"a_10.npz: wanted one pose, got more; name a file"):
        read_motion(folder)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1, 2], "wanted 'poses', got no named arrays; give a file with poses"),
        ("dance", "wanted 'poses', got no named arrays"),
        ({"smpl_trans": np.zeros((2, 3))}, "wanted 'poses', got smpl_trans"),
        ({"smpl_poses": "dance"}, "smpl_poses: wanted an array, got str"),
        (
            {"smpl_poses": np.zeros((2, 72)), "smpl_trans": np.zeros((2, 3)), "smpl_scaling": -1.0},
            "wanted one positive number",
        ),
    ],
)
def test_pickles_that_are_no_dances(tmp_path, content, message):
    path = tmp_path / "dance.pkl"
    path.write_bytes(pickle.dumps(content))
    with pytest.raises(UserError, match=message) as caught:
        read_motion(path)
    assert "dance.pkl" in str(caught.value)


def test_a_pickle_that_runs_code_is_refused(tmp_path):
    class Code:
        def __reduce__(self):
            return print, ("run",)

    (tmp_path / "dance.pkl").write_bytes(pickle.dumps({"smpl_poses": Code()}))
    with pytest.raises(UserError, match="print"):
        read_motion(tmp_path / "dance.pkl")


def test_clip_and_mapping_are_for_rigs(tmp_path):
    path = save(tmp_path, **amass_arrays())
    for setting in ({"clip": 0}, {"mapping": {}}):
        message = f"{next(iter(setting))}: wanted a file ending in .bvh, .glb, .gltf, .vrm, .vrma, got pose file .*leave it out"
        with pytest.raises(UserError, match=message):
            read_motion(path, **setting)
