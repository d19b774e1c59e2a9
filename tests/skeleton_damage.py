"""Skeleton and pose files for the fuzzer, and damage that replaces values by wrong ones."""

from __future__ import annotations

import io
import json
import random
from pathlib import Path

import numpy as np

from snarfcli.datasets.skeleton_files import read_poses, read_skeleton
from snarfcli.errors import UserError

__all__ = ["damaged_json", "damaged_npz", "read_both", "seeds_json", "seeds_npz"]

_SKELETON = {
    "names": ["hips", "spine", "head"],
    "parents": [-1, 0, 1],
    "joints_rest": [[0.0, 1.0, 0.0], [0.0, 1.5, 0.0], [0.0, 2.0, 0.1]],
    "canonical_pose": [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.3]],
    "up": "z",
    "scale": 0.01,
}
_POSES = {"poses": np.linspace(0, 1, 18).reshape(2, 3, 3).tolist(), "trans": [[0, 0, 1], [0, 0, 2]], "frame_rate": 24}
_TRANSFORMS = {"bone_transforms": np.tile(np.eye(4), (2, 3, 1, 1)).tolist(), "fps": 30.0}
_WORDS = [
    None, True, -1, 2**32 - 1, 10**400, 1e308, float("nan"), float("inf"), "", "hips", "a\nb", "x" * 5000, [], {}, [[]], [[[]]],
    [None], [1, [2]], {"a": 1}, [0] * 5000, [[0, 1, 2]] * 3, [1, 2, 0], [0, 0, 0], ["head", "hips", "spine"], "y", 0, -0.5,
]  # fmt: skip


def read_both(path: Path) -> object:
    """Read a file as a skeleton and as poses."""
    try:
        order = read_skeleton(path).order
    except UserError as error:
        if path.name not in str(error):
            raise
        order = np.arange(3)
    return read_poses(path, order)


def seeds_json() -> list[bytes]:
    parts = (_POSES, _TRANSFORMS, _SKELETON | _POSES, _SKELETON | _TRANSFORMS)
    return [json.dumps(content).encode() for content in parts]


def seeds_npz() -> list[bytes]:
    return [_saved(content) for content in (_POSES, _TRANSFORMS, _SKELETON | _POSES, _SKELETON | _TRANSFORMS)]


def damaged_json(rng: random.Random, content: bytes) -> bytes:
    """Replace the value of a key, or a part of it, by a wrong one."""
    values = json.loads(json.dumps(rng.choice([_SKELETON, _POSES, _TRANSFORMS])))
    key = rng.choice(list(values))
    holder, place = values, key
    while isinstance(holder[place], list) and holder[place] and rng.random() < 0.6:
        holder, place = holder[place], rng.randrange(len(holder[place]))
    holder[place] = rng.choice(_WORDS)
    return json.dumps(values).encode()


def damaged_npz(rng: random.Random, content: bytes) -> bytes:
    """Give an array another type, other dimensions, or numbers that are not finite."""
    values = dict(rng.choice([_SKELETON, _POSES, _TRANSFORMS]))
    key = rng.choice(list(values))
    array = np.array(values[key])
    change = rng.randrange(6)
    if change == 0:
        kinds = ["S2"] if array.dtype.kind == "U" else ["U8", "S3", "u1", "f2", "i8", "c16", "M8[s]"]
        array = array.astype(rng.choice(kinds))
    elif change == 1:
        array = array.reshape(-1)[: rng.randrange(array.size + 1)]
    elif change == 2:
        array = array[None]
    elif change == 3:
        array = np.zeros([rng.choice([0, 1, 2, 3, 4, 9]) for _ in range(rng.randrange(5))], array.dtype)
    elif change == 4 and array.dtype.kind == "f" and array.size:
        array.reshape(-1)[rng.randrange(array.size)] = rng.choice([np.nan, np.inf, 1e300])
    else:
        array = np.array(rng.choice(["", "y", "q" * 3000, 0, -1, 2**40, 1.5]))
    return _saved(values | {key: array})


def _saved(content: dict) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **{name: np.array(value) for name, value in content.items()})
    return buffer.getvalue()
