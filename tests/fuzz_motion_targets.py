"""Targets of the fuzzer for files of motions."""

from __future__ import annotations

import random
import zlib
from collections.abc import Callable

import numpy as np
from fuzz_arrays import even_numbers, odd_npz
from fuzzing import Target

__all__ = ["MOTION_TARGETS", "like_joblib"]


def motion_npz() -> Target:
    import io

    from snarfcli.motions import read_motion

    def seeds() -> list[bytes]:
        old = {"poses": even_numbers(2, 156), "trans": np.zeros((2, 3)), "mocap_framerate": 120.0, "gender": b"male"}
        parts = {
            "root_orient": even_numbers(3, 3),
            "pose_body": even_numbers(3, 63),
            "pose_hand": even_numbers(3, 90),
            "mocap_frame_rate": 60,
        }
        smplx = {"global_orient": even_numbers(2, 3), "body_pose": even_numbers(2, 69), "left_hand_pose": even_numbers(2, 45)}
        matrices = {"poses": np.tile(np.eye(3, dtype=np.float32), (1, 24, 1, 1)), "transl": np.ones((1, 3), "f4")}
        made = []
        for arrays in (old, parts, smplx, matrices, {"pose": even_numbers(1, 72)[0]}):
            buffer = io.BytesIO()
            (np.savez_compressed if arrays is parts else np.savez)(buffer, **arrays)
            made.append(buffer.getvalue())
        return made

    return Target("motion_npz", ".npz", seeds, read_motion, odd_npz)


def motion_pkl() -> Target:
    import pickle

    from snarfcli.motions import read_motion

    def seeds() -> list[bytes]:
        dance = {
            "smpl_poses": even_numbers(2, 72),
            "smpl_trans": np.ones((2, 3)),
            "smpl_scaling": np.array([93.5]),
            "smpl_loss": 0.1,
        }
        plain = {"poses": even_numbers(1, 72), "trans": np.zeros((1, 3)), "gender": "male"}
        return [pickle.dumps(dance, 2), pickle.dumps(dance, 4), pickle.dumps(plain, 0), pickle.dumps(plain, 5)]

    return Target("motion_pkl", ".pkl", seeds, read_motion)


def motion_bvh() -> Target:
    import tempfile
    from pathlib import Path

    from toy_rigs import CMU_NAMES, MIXAMO_NAMES, a_pose, rig_of, write_bvh

    from snarfcli.motions import read_motion

    def seeds() -> list[bytes]:
        poses = even_numbers(2, 72).reshape(2, 24, 3).astype(np.float64)
        rigs = [rig_of(poses, np.zeros((2, 3)), CMU_NAMES, scale=100)]
        rigs.append(rig_of(poses, np.ones((2, 3)), MIXAMO_NAMES, rest_pose=a_pose()))
        with tempfile.TemporaryDirectory() as folder:
            return [write_bvh(Path(folder) / "seed.bvh", rig).read_bytes() for rig in rigs]

    return Target("motion_bvh", ".bvh", seeds, read_motion)


def motion_pt() -> Target:
    """Results of video estimators as `torch.save` writes them, in both formats."""
    import torch
    from estimates import gvhmr, saved

    from snarfcli.motions import read_motion

    def seeds() -> list[bytes]:
        poses = even_numbers(2, 72).reshape(2, 24, 3).astype(np.float64)
        results = gvhmr(poses, np.ones((2, 3)))
        small = {"poses": torch.from_numpy(poses).half(), "fps": torch.tensor(30).bfloat16(), "notes": ["a", (1, 2.5, None)]}
        return [saved(results), saved(results, is_zip=False), saved(small), saved(small, is_zip=False)]

    return Target("motion_pt", ".pt", seeds, read_motion, _odd_pt)


def _odd_pt(rng: random.Random, content: bytes) -> bytes:
    """Return a file of PyTorch whose pickle or storages are damaged; its archive stays valid."""
    import zipfile

    from estimates import rezipped
    from fuzz_damage import DAMAGES
    from pickle_damage import damaged

    if content[:2] != b"PK":
        return damaged(rng, content)
    chosen = rng.choice(["data.pkl", "data.pkl", "data.pkl", "data/", "byteorder"])

    def change(name: str, data: bytes) -> bytes | None:
        if chosen not in name:
            return data
        if chosen == "data.pkl":
            return damaged(rng, data)
        return rng.choice([None, b"", data[: len(data) // 2], data * 3, rng.choice(DAMAGES)(rng, data, b"big")])

    try:
        return rezipped(content, change)
    except zipfile.BadZipFile:
        return content


def motion_estimate() -> Target:
    """Results of video estimators as pickles, with what joblib and PyTorch write."""
    import pickle

    import torch
    from estimates import wham
    from pickle_damage import damaged

    from snarfcli.motions import read_motion

    def seeds() -> list[bytes]:
        poses = even_numbers(2, 72).reshape(2, 24, 3).astype(np.float64)
        person = wham(poses, np.ones((2, 3)))
        tensors = {key: torch.from_numpy(value).float() for key, value in person.items()}
        pictures = {f"{number}.jpg": {"tid": [1], "smpl": [{"pose": poses[number].ravel()}]} for number in range(2)}
        plain = [pickle.dumps(content, protocol) for content in ({0: person, 1: tensors}, pictures) for protocol in (2, 4)]
        return [*plain, like_joblib(poses.reshape(2, 72)), zlib.compress(like_joblib(poses.reshape(2, 72)))]

    return Target("motion_estimate", ".pkl", seeds, read_motion, damaged)


def like_joblib(array: np.ndarray) -> bytes:
    """Return {0: {"poses": array}} in a defaultdict as joblib writes it: the array's bytes follow its description."""
    import pickle

    state = {"shape": array.shape, "order": "C", "dtype": array.dtype, "allow_mmap": True, "numpy_array_alignment_bytes": 16}
    wrapper = b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n)\x81" + pickle.dumps(state, 2)[2:-1] + b"b"
    padded = b"\x05" + b"\xff" * 5 + array.tobytes()
    head = b"\x80\x02ccollections\ndefaultdict\nc__builtin__\ndict\n\x85RK\x00}X\x05\x00\x00\x00poses"
    return head + wrapper + padded + b"ss."


def motion_mhr() -> Target:
    """Joints of MHR, as SAM 3D Body writes them."""
    import io

    from estimates import mhr_person

    from snarfcli.motions import read_motion

    def seeds() -> list[bytes]:
        made = []
        for person in ({key: value[0] for key, value in mhr_person().items()}, mhr_person(frames=3)):
            for content in (person, {"results": np.array([person], object)}):
                buffer = io.BytesIO()
                np.savez(buffer, **content)
                made.append(buffer.getvalue())
        return made

    return Target("motion_mhr", ".npz", seeds, read_motion, _odd_mhr)


def _odd_mhr(rng: random.Random, content: bytes) -> bytes:
    """Return another archive: its arrays, or the pickle in one, are damaged."""

    from estimates import rezipped
    from pickle_damage import damaged

    if b"results.npy" not in content:
        return odd_npz(rng, content)
    return rezipped(content, lambda _, data: data[:128] + damaged(rng, data[128:]))


MOTION_TARGETS: tuple[Callable[[], Target], ...] = (
    motion_npz,
    motion_pkl,
    motion_bvh,
    motion_pt,
    motion_estimate,
    motion_mhr,
)
