"""Pose files that would hang a reader, fill the memory, or mean something else than they seem to."""

from __future__ import annotations

import pickle
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError
from snarfcli.motions import builtin_motion, read_motion
from snarfcli.motions.anatomy import joint_positions
from snarfcli.motions.up_axis import hangs_head_down

_OLD = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03."
MOTION = builtin_motion("punching", 3, duration_s=0.5)


def calls_of_load_from_bytes(content: bytes, count: int) -> bytes:
    """Return a pickle with a list of calls that share one argument through the memo."""
    load = b"ctorch.storage\n_load_from_bytes\n"
    start = b"\x80\x02" + load + b"q\x00B" + struct.pack("<I", len(content)) + content + b"q\x010]"
    return start + b"(" + b"h\x00h\x01\x85R" * count + b"e."


def test_storages_that_are_shared_are_read_once(tmp_path, monkeypatch):
    from snarfcli.formats import torch_files

    reads = []
    original = torch_files._old_content
    monkeypatch.setattr(torch_files, "_old_content", lambda *args: reads.append(1) or original(*args))
    _, (content,) = torch.zeros(4)._typed_storage().__reduce__()
    (tmp_path / "a.pkl").write_bytes(calls_of_load_from_bytes(content, 2000))
    with pytest.raises(UserError):
        read_motion(tmp_path / "a.pkl")
    assert len(reads) == 1
    assert torch_files.storage_of(content, 1000).tolist() == [0, 0, 0, 0]  # so the content was good


def test_a_pickle_cannot_name_the_readers_own_kinds(tmp_path):
    content = _OLD + b"}.c\nstored\n)R.]."
    hostile = b"\x80\x02ctorch.storage\n_load_from_bytes\nB" + struct.pack("<I", len(content)) + content + b"\x85R."
    (tmp_path / "a.pkl").write_bytes(hostile)
    with pytest.raises(UserError):
        read_motion(tmp_path / "a.pkl")


def test_large_tensors_of_bfloat16_are_read(tmp_path):
    poses = torch.zeros(30_000, 72, dtype=torch.bfloat16)
    poses[:, 3] = 0.5
    torch.save({"poses": poses}, tmp_path / "a.pt")
    motion = read_motion(tmp_path / "a.pt")
    assert motion.num_frames == 30_000
    np.testing.assert_array_equal(motion.poses[:, 1, 0], 0.5)


def test_long_clips_are_judged_from_some_frames(monkeypatch):
    from snarfcli.motions import up_axis

    seen = []
    original = up_axis._from_feet_to_head
    monkeypatch.setattr(up_axis, "_from_feet_to_head", lambda poses: seen.append(len(poses)) or original(poses))
    poses = np.zeros((50_000, 24, 3))
    poses[:, 0, 0] = np.pi
    assert hangs_head_down(poses, is_likely=False)
    assert max(seen) <= 2000


@pytest.mark.parametrize(("name", "value"), [("Rh", 1e200), ("Rh", 90.0), ("Th", 1e30)])
def test_placements_that_are_none(tmp_path, name, value):
    arrays = {"Rh": np.zeros((4, 3)), "Th": np.zeros((4, 3))}
    arrays[name] = np.full((4, 3), value)
    np.savez(tmp_path / "a.npz", poses=np.zeros((4, 72)), **arrays)
    with pytest.raises(UserError, match="wanted radians and metres"):
        read_motion(tmp_path / "a.npz")


@pytest.mark.parametrize(("root", "body"), [("global_orient", "body_pose"), ("root_orient", "pose_body")])
def test_positions_in_parts_are_refused(tmp_path, root, body):
    places = joint_positions(MOTION.poses, MOTION.translation)[0][:, :22]
    np.savez(tmp_path / "a.npz", **{root: places[:, 0], body: places[:, 1:].reshape(len(places), -1)})
    with pytest.raises(UserError, match="got joint positions"):
        read_motion(tmp_path / "a.npz")


@pytest.mark.parametrize("suffix", ["pkl", "joblib", "npy"])
def test_folders_of_frames_in_every_format(tmp_path, suffix):
    folder = tmp_path / "frames"
    folder.mkdir()
    for frame in range(5):
        file = folder / f"{frame}.{suffix}"
        if suffix == "npy":
            np.save(file, MOTION.poses[frame].ravel())
        else:
            file.write_bytes(pickle.dumps({"poses": MOTION.poses[frame].ravel()}))
    motion = read_motion(folder)
    np.testing.assert_allclose(motion.poses, MOTION.poses[:5], atol=1e-12)


def test_the_clip_tells_nothing_about_the_rest_pose_of_an_animal(tmp_path):
    chain = Skeleton(("a", "b", "c"), (-1, 0, 1), torch.tensor([[0.0, 0, 0], [0, 1, 0], [0, 2, 0]]), torch.zeros(3, 3))
    text = "HIERARCHY\nROOT a { OFFSET 0 0 0 CHANNELS 3 Zrotation Xrotation Yrotation\nJOINT b { OFFSET 0 5 0 CHANNELS 0\n"
    text += "JOINT c { OFFSET 0 5 0 CHANNELS 0 } } }\nMOTION\nFrames: 1\nFrame Time: 0.1\n0 0 0\n"
    Path(tmp_path / "a.bvh").write_text(text)
    with pytest.raises(UserError, match="rest=clip: wanted the skeleton of a person"):
        read_motion(tmp_path / "a.bvh", chain, rest="clip")
    with pytest.raises(UserError, match="rest: wanted auto, file, clip"):
        read_motion(tmp_path / "a.bvh", chain, rest="9" * 5000)
