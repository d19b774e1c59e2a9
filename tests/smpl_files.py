"""Body files in the released forms of SMPL, SMPL-H and SMPL-X, made from the built-in body and from small examples."""

from __future__ import annotations

import io
import pickle
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import scipy.sparse

from snarfcli.bodies import builtin_body

__all__ = ["octahedron", "pickled", "smpl", "toy", "write_npz", "write_pickle"]


def octahedron() -> dict[str, Any]:
    """Two bones along y, an octahedron around them."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    upper = np.float32(vertices[:, 1] > 0)
    return {
        "v_template": vertices,
        "f": np.array(faces, np.uint32),
        "weights": np.stack([1 - upper, upper], 1),
        "J_regressor": np.full((2, 6), 1 / 6, np.float32),
        "kintree_table": np.array([[2**32 - 1, 0], [0, 1]], np.uint32),
        "shapedirs": np.zeros((6, 3, 2), np.float32),
        "posedirs": np.zeros((6, 3, 9), np.float32),
    }


def smpl(shapes: int = 10) -> dict[str, Any]:
    """The built-in body with SMPL's own types: float64, uint32, a sparse regressor; components beyond 10 are random."""
    import torch

    body = builtin_body(torch.float64)
    more = 1e-3 * np.random.default_rng(0).normal(size=(len(body.v_template), 3, max(shapes - 10, 0)))
    return {
        "v_template": body.v_template.numpy(),
        "f": body.faces.numpy().astype(np.uint32),
        "weights": body.weights.numpy(),
        "J_regressor": scipy.sparse.csc_matrix(body.joint_regressor.numpy()),
        "J_regressor_prior": scipy.sparse.csc_matrix(body.joint_regressor.numpy()),
        "kintree_table": np.array([[2**32 - 1, *body.parents[1:]], range(24)], np.uint32),
        "shapedirs": np.concatenate([body.shapedirs.numpy(), more], 2)[..., :shapes],
        "posedirs": body.posedirs.numpy(),
        "bs_type": "lrotmin",
        "bs_style": "lbs",
    }


def toy(joints: int, shapes: int, vertices: int = 80, seed: int = 0) -> dict[str, Any]:
    """Random numbers in the shape of a body with any number of joints: 52 as SMPL-H, 55 as SMPL-X, 33 as an animal."""
    rng = np.random.default_rng(seed)
    weights = rng.random((vertices, joints)) ** 8
    regressor = rng.random((joints, vertices)) * (rng.random((joints, vertices)) < 0.2)
    regressor[:, 0] += 0.1
    parents = [-1] + [int(rng.integers(max(0, joint - 5), joint)) for joint in range(1, joints)]
    return {
        "v_template": rng.normal(size=(vertices, 3)),
        "f": rng.integers(0, vertices, (2 * vertices, 3)),
        "weights": weights / weights.sum(1, keepdims=True),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "kintree_table": np.array([parents, range(joints)]),
        "shapedirs": 0.1 * rng.normal(size=(vertices, 3, shapes)),
        "posedirs": 0.01 * rng.normal(size=(vertices, 3, 9 * (joints - 1))),
    }


def write_npz(path: Path, arrays: dict[str, Any]) -> Path:
    """Write an `.npz` file of plain arrays."""
    dense = {key: value.toarray() if scipy.sparse.issparse(value) else value for key, value in arrays.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **dense)
    return path


def write_pickle(path: Path, arrays: dict[str, Any], **options: Any) -> Path:
    """Write a pickle; the options are `pickled`'s."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickled(arrays, **options))
    return path


def pickled(arrays: dict[str, Any], *, chumpy: tuple[str, ...] = ("shapedirs",), selected: int = 0) -> bytes:
    """Pickle a body as Python 2 did, protocol 2, without chumpy.

    Args:
        arrays: by name.
        chumpy: the names of those that are chumpy objects.
        selected: where positive, shapedirs is a selection from this many further components, as in MANO.
    """
    with _chumpy_modules() as (value, selection):
        content = dict(arrays)
        for key in chumpy:
            made = value.__new__(value)
            made.__dict__ = {"x": arrays[key], "_dirty_vars": set(), "_itr": None, "_status": "new", "_make_dense": False}
            if key == "shapedirs" and selected:
                whole = np.concatenate([arrays[key], np.full((*arrays[key].shape[:2], selected), 9.0)], 2)
                made.__dict__["x"] = whole
                chosen = np.arange(whole.size).reshape(whole.shape)[..., : arrays[key].shape[2]]
                source, made = made, selection.__new__(selection)
                made.__dict__ = {"a": source, "idxs": chosen.ravel(), "preferred_shape": chosen.shape, "_dirty_vars": set()}
            content[key] = made
        buffer = io.BytesIO()
        _Python2Pickler(buffer, protocol=2).dump(content)
    data = buffer.getvalue()
    for new, old in ((b"cnumpy._core.", b"cnumpy.core."), (b"cscipy.sparse._csc\n", b"cscipy.sparse.csc\n")):
        data = data.replace(new, old)
    return data


class _Python2Pickler(pickle._Pickler):
    """Write text and bytes as Python 2 wrote its strings."""

    dispatch: ClassVar = dict(pickle._Pickler.dispatch)

    def save_string(self, text: str | bytes) -> None:
        content = text.encode("latin1") if isinstance(text, str) else text
        self.write(b"U" + bytes([len(content)]) if len(content) < 256 else b"T" + struct.pack("<i", len(content)))
        self.write(content)
        self.memoize(text)

    dispatch[str] = dispatch[bytes] = save_string


@contextmanager
def _chumpy_modules() -> Iterator[tuple[type, type]]:
    """Make classes that are pickled like those of chumpy."""
    modules = {name: ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering")}
    classes = type("Ch", (), {"__module__": "chumpy.ch"}), type("Select", (), {"__module__": "chumpy.reordering"})
    modules["chumpy.ch"].Ch, modules["chumpy.reordering"].Select = classes
    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        yield classes
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module
