"""Damage to the formats of this package that targets their readers.

Values, types, shapes and names in the tree are changed, and the file around them (zip, checksums, sizes) is valid again.
"""

from __future__ import annotations

import copy
import io
import json
import random
from typing import Any

import numpy as np
import torch
from estimates import rezipped
from fuzz_damage import DAMAGES
from pickle_damage import damaged as damaged_pickle

__all__ = ["damaged_array", "damaged_json", "damaged_npz", "damaged_torch", "damaged_tree"]

_WORDS: list[Any] = [
    None, True, False, -1, 0, 1, 2, 3, 7, 255, 10**6, 2**31, 2**32 - 1, 2**62, 0.5, -0.5, 1e30, 1e-30, 1e308, float("nan"),
    float("inf"), "", "x", "x" * 3000, "a\nb", "x\x1b[2J", "\u2028", "..", "../../etc", "/etc/passwd", "C:\\x", "train", "ood",
    "${oc.env:HOME}", "${.}", "???", "mlp", "voxel", "preset", "broyden", "smpl_nn", "nasa", "local", "hierarchical", "relu",
    [], {}, [[]], [None], [0, 0, 0], [1, 2, 3], [2, 2, 2], [1000, 1000, 1000], [0] * 3000, ["a", "b"], {"a": 1}, [{}],
]  # fmt: skip
_LONG_WORDS: list[Any] = [10**400, -(2**63) - 1, "\ud800", [[[[[[]]]]]] * 9]


def damaged_tree(rng: random.Random, tree: Any) -> Any:
    """Change one to three entries of nested dicts and lists; tensors get another shape, type or other values."""
    tree = copy.deepcopy(tree)
    for _ in range(rng.choice([1, 1, 2, 3])):
        owner: Any = {"": tree}
        key: Any = ""
        while isinstance(owner[key], (dict, list)) and owner[key] and (key == "" or rng.random() < 0.93):
            owner = owner[key]
            key = rng.choice(list(owner)) if isinstance(owner, dict) else rng.randrange(len(owner))
        if key == "":
            return copy.deepcopy(rng.choice(_WORDS))
        _change(rng, owner, key)
    return tree


def _change(rng: random.Random, owner: Any, key: Any) -> None:
    """Change one entry of a dict or list."""
    action = rng.random()
    if isinstance(owner[key], torch.Tensor) and action < 0.8:
        owner[key] = _damaged_tensor(rng, owner[key])
    elif action < 0.12:
        del owner[key]
    elif action < 0.2 and isinstance(owner, list):
        owner.extend(copy.deepcopy(owner[key]) for _ in range(rng.choice([1, 2, 1000])))
    elif action < 0.2 and isinstance(owner, dict):
        owner[rng.choice([*owner, "extra", "\x1b[31m", "idle", "template", 3])] = owner.pop(key)
    elif action < 0.35:
        owner[key] = copy.deepcopy(rng.choice(list(owner.values()) if isinstance(owner, dict) else owner))
    elif action < 0.5 and isinstance(owner[key], (int, float)) and not isinstance(owner[key], bool):
        owner[key] = type(owner[key])(owner[key] * rng.choice([-1, 2, 10, 1000])) + rng.choice([-1, 0, 1])
    else:
        owner[key] = copy.deepcopy(rng.choice(_WORDS if rng.random() < 0.95 else _LONG_WORDS))


def _damaged_tensor(rng: random.Random, tensor: torch.Tensor) -> Any:
    """Return another tensor, of any layout and type that `torch.save` writes."""
    kind = rng.randrange(11)
    if tensor.numel() > 10**5 or tensor.layout != torch.strided or tensor.device.type == "meta":  # changed before
        return tensor
    if kind < 4:
        changed = tensor.clone()
        flat = changed.reshape(-1)
        if len(flat):
            at = rng.randrange(len(flat))
            worst = [np.nan, np.inf, -np.inf, 1e30, -1e30, 1e38, 1e6, 1e-40, 0.0, -1.0, 1.0]
            some = worst if changed.is_floating_point() else [0, 1, -1, 2, 100, 127, -128]
            value = rng.choice(some)
            if changed.dtype in (torch.bool, torch.uint8):
                value = int(value) & 1
            flat[at if rng.random() < 0.6 else slice(None)] = value
            changed = flat.reshape(changed.shape)
        return changed
    if kind == 4:
        return tensor * rng.choice([1000, -1, 0]) if tensor.dtype != torch.bool else ~tensor
    if kind == 5:
        return tensor.to(rng.choice([torch.float64, torch.float16, torch.int64, torch.int32, torch.bool, torch.complex64]))
    if kind == 6:
        return tensor.reshape(-1)[: rng.randrange(tensor.numel() + 1)]
    if kind == 7:
        return tensor[None] if rng.random() < 0.5 else tensor.T.contiguous() if tensor.ndim == 2 else tensor.reshape(-1, 1)
    if kind == 8:
        return torch.zeros(1, dtype=tensor.dtype).expand(rng.choice([(3,), (3, 3), (10**6, 10**6), (6, 6), (2**40,)]))
    if kind == 9:
        odd = [torch.zeros(0), torch.eye(3).to_sparse(), torch.zeros(3, device="meta"), torch.zeros(2, 3).bfloat16()]
        return rng.choice(odd)
    return torch.nn.Parameter(tensor.float()) if rng.random() < 0.5 else torch.cat([tensor.reshape(-1)] * 2)


def damaged_torch(rng: random.Random, content: bytes) -> bytes:
    """Return a file of `torch.save` with a damaged tree, or with a damaged pickle or storage in a valid archive."""
    if rng.random() < 0.25:
        chosen = rng.choice(["data.pkl", "data/", "byteorder", "version"])

        def change(name: str, data: bytes) -> bytes | None:
            if chosen not in name or rng.random() < 0.5:
                return data
            if chosen == "data.pkl":
                return damaged_pickle(rng, data)
            return rng.choice([None, b"", data[: len(data) // 2], data * 3, rng.choice(DAMAGES)(rng, data, b"big")])

        return rezipped(content, change)
    buffer = io.BytesIO()
    tree = torch.load(io.BytesIO(content), weights_only=True)
    torch.save(damaged_tree(rng, tree), buffer)
    return buffer.getvalue()


def damaged_json(rng: random.Random, content: bytes) -> bytes:
    """Return a JSON file with a damaged tree."""
    tree = damaged_tree(rng, json.loads(content))
    text = json.dumps(tree)
    if rng.random() < 0.03:
        text = text.replace(":", ': 1, "frames":', 1) if rng.random() < 0.5 else "[" * 100_000
    return text.encode()


def damaged_array(rng: random.Random, array: np.ndarray) -> np.ndarray:
    """Return an array with another type, shape or other values."""
    if array.dtype.kind == "M":  # changed before; NumPy does not turn it into any type
        return array
    kind = rng.randrange(7)
    with np.errstate(all="ignore"):
        if kind == 0:
            kinds = ["f2", "f4", "f8", "i1", "i4", "i8", "u8", "?", "c8", ">f4", "S3", "U4", "M8[s]"]
            return array.astype(rng.choice(kinds if array.dtype.kind not in "US" else ["S3", "U9"]))
        if kind == 1:
            return array.reshape(-1)[: rng.randrange(array.size + 1)]
        if kind == 2:
            return array[None] if rng.random() < 0.5 else np.asfortranarray(array.T)
        if kind == 3:
            return np.zeros([rng.choice([0, 1, 2, 3, 4, 9]) for _ in range(rng.randrange(5))], array.dtype)
        if kind == 4 and array.ndim:
            return np.repeat(array, rng.choice([0, 2, 3]), rng.randrange(array.ndim))
        changed = array.copy().reshape(-1)
        if changed.size and array.dtype.kind not in "US":
            worst = [np.nan, np.inf, 1e30, -1.0, 0.0, 1e6, 1e-40] if array.dtype.kind == "f" else [0, 1, -1, 2, 100, 2**31 - 1]
            at = rng.randrange(changed.size) if rng.random() < 0.7 else slice(None)
            changed[at] = np.array(rng.choice(worst)).astype(array.dtype)
        elif changed.size:
            changed[rng.randrange(changed.size)] = rng.choice(["", "\x1b[2J", "x" * 99])
    return changed.reshape(array.shape)


def damaged_npz(rng: random.Random, content: bytes) -> bytes:
    """Return an archive of arrays with one to three of them damaged, renamed or left out."""
    with np.load(io.BytesIO(content)) as archive:
        arrays = {key: archive[key] for key in archive.files}
    for _ in range(rng.choice([1, 1, 2, 3])):
        if not arrays:
            break
        key = rng.choice(list(arrays))
        action = rng.random()
        if action < 0.1:
            del arrays[key]
        elif action < 0.2:
            arrays[rng.choice([*arrays, "extra", "up", "idle"])] = arrays[key]
        else:
            arrays[key] = damaged_array(rng, arrays[key])
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()
