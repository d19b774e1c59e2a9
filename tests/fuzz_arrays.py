"""Arrays in the seeds of the fuzzer, and files of arrays with wrong shapes, types and values."""

from __future__ import annotations

import io
import random

import numpy as np

__all__ = ["even_numbers", "odd_npz"]


def even_numbers(rows: int, columns: int) -> np.ndarray:
    """Return numbers from -0.5 to 0.5, float32, as poses or points."""
    return np.linspace(-0.5, 0.5, rows * columns, dtype=np.float32).reshape(rows, columns)


def odd_npz(rng: random.Random, content: bytes) -> bytes:
    """Return another archive: the arrays of the seed with wrong shapes, types and values."""
    np.seterr(all="ignore")
    with np.load(io.BytesIO(content)) as archive:
        arrays = {key: archive[key] for key in archive.files}
    for _ in range(rng.choice([1, 1, 2, 3])):
        key = rng.choice(list(arrays))
        array = arrays[key]
        kind = rng.randrange(8)
        if kind == 0:
            array = array.ravel()
        elif kind == 1:
            array = array[None] if rng.random() < 0.5 else array[..., None]
        elif kind == 2:
            kinds = ["S4", "U8", "O"] + ["f2", "f8", "i1", "u8", ">f4", "c8", "?"] * (array.dtype.kind == "f")
            with np.errstate(all="ignore"):
                array = array.astype(rng.choice(kinds))
        elif kind == 3:
            array = np.repeat(array, rng.choice([0, 2, 3]), rng.randrange(array.ndim)) if array.ndim else np.zeros(0)
        elif kind == 4 and array.dtype.kind == "f":
            with np.errstate(all="ignore"):
                array = array * rng.choice([np.nan, np.inf, 1e30, 180.0, 0.0, -1.0, 1e-30])
        elif kind == 5:
            array = np.asfortranarray(array.T)
        elif kind == 6:
            array = np.zeros(rng.choice([(), (0,), (0, 72), (72, 0), (1, 1, 1, 1), (24, 3), (2, 52, 3), (1, 66), (3, 0, 3, 3)]))
        else:
            other = rng.choice(
                ["poses", "pose", "trans", "smpl_scaling", "fps", "root_orient", "pose_body", "smpl_poses", "body_pose", "up",
                 "global_orient", "pose_world", "left_hand_pose", "rest_up", "metres_per_unit",
                 "Rh", "Th", "pred_cam_t", "results", "pred_global_rots"]
            )  # fmt: skip
            arrays[other] = array
            continue
        arrays[key] = array
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()
