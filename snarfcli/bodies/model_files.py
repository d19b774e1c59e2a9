"""Read body models in SMPL's format: the released files of SMPL, SMPL-H and SMPL-X, and bodies of other skeletons."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from snarfcli.array_files import read_npz
from snarfcli.bodies.body import Body
from snarfcli.bodies.skeleton import MAX_JOINTS, SMPL_JOINT_NAMES, SMPLH_JOINT_NAMES, SMPLX_JOINT_NAMES
from snarfcli.errors import UserError
from snarfcli.formats.pickle_numbers import SparseMatrix
from snarfcli.formats.pickles import read_pickle

__all__ = ["load_body"]

log = logging.getLogger(__name__)

_REQUIRED_KEYS = ("v_template", "f", "weights", "J_regressor", "kintree_table", "shapedirs")
_KEYS = (*_REQUIRED_KEYS, "posedirs", "joint_names")
_JOINT_NAMES = {len(names): names for names in (SMPL_JOINT_NAMES, SMPLH_JOINT_NAMES, SMPLX_JOINT_NAMES)}
_MAX_SHAPES = 300  # of SMPL v1.1.0 and SMPL-X
# Components of SMPL-X files: first shape, then expression; smplx 0.1.28 cuts them at the same places.
_SHAPES_OF_SMPLX = {20: 10, 400: 300}
# Weights are not normalised. Rows of four weights stored as float16 sum to 1 within 1e-3.
_ROW_SUM_TOLERANCE = 1e-2


def load_body(path: str | Path, *, dtype: torch.dtype = torch.float32, num_betas: int | None = None) -> Body:
    """Read an SMPL-format body: SMPL v1.0.0 and v1.1.0, SMPL-H, SMPL-X, MANO, SMAL, `.npz` or `.pkl`.

    Downloaded pickles need neither chumpy nor Python 2, and nothing in them is executed.

    Args:
        path: file with the arrays v_template, f, weights, J_regressor, kintree_table and shapedirs, named and shaped as in
            SMPL. `posedirs` may be [V, 3, P], [3V, P] or [P, 3V], or missing: the body then has no pose correctives.
            `joint_names` is optional. Expressions, textures and hand components are left out.
        dtype: float32 or float64.
        num_betas: maximum number of shape parameters to keep; all by default, at most 300. The time to pose is proportional to
            the number of betas given, the memory to the number kept.

    Raises:
        UserError: the file is missing, damaged or of another kind, lacks an array, or has arrays that do not fit together.
        ValueError: num_betas is negative.
    """
    path = Path(path)
    if num_betas is not None and num_betas < 0:
        raise ValueError(f"num_betas: wanted at least 0, got {num_betas}")
    arrays = _arrays(path)
    vertices, joints = _check_shapes(arrays, path)
    parents = _parents(arrays["kintree_table"], path)
    faces = _faces(arrays["f"], vertices, path)
    shapes: int = min(arrays["shapedirs"].shape[2], _MAX_SHAPES)
    if joints == len(SMPLX_JOINT_NAMES):
        shapes = _SHAPES_OF_SMPLX.get(int(arrays["shapedirs"].shape[2]), shapes)
    arrays["shapedirs"] = arrays["shapedirs"][:, :, : shapes if num_betas is None else min(shapes, num_betas)]
    if "posedirs" in arrays:
        arrays["posedirs"] = _pose_directions(arrays["posedirs"], vertices, 9 * (joints - 1), path)
    else:
        log.info("%s: no posedirs; the body is posed without pose correctives", path.name)
        arrays["posedirs"] = np.zeros((vertices, 3, 0))

    def tensor(key: str) -> Tensor:
        return _tensor(arrays.pop(key), dtype, f"body {path}: {key}")  # pop frees each array after its conversion

    weights = tensor("weights")
    error = (weights.double().sum(1) - 1).abs().max().item()
    if error > _ROW_SUM_TOLERANCE:
        raise UserError(f"body {path}: weights: wanted rows that sum to 1, got an error of {error:.3g}; get another copy")
    return Body(
        v_template=tensor("v_template"),
        faces=torch.from_numpy(faces),
        weights=weights,
        parents=parents,
        joint_names=_names(arrays.get("joint_names"), joints),
        joint_regressor=tensor("J_regressor"),
        shapedirs=tensor("shapedirs"),
        posedirs=tensor("posedirs"),
    )


def _arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of a body by name: numbers, or the sparse J_regressor."""
    kind = path.suffix.lower()
    if kind == ".npz":
        # The archives of SMPL-X also contain pickled dictionaries, which are not read.
        content = read_npz(path, "body", only=_KEYS)
    elif kind in (".pkl", ".pickle"):
        content = read_pickle(path, "body")
    else:
        raise UserError(f"body {path}: wanted an .npz or .pkl file; name a body in SMPL's format")
    if not isinstance(content, dict):
        wanted = f"named arrays ({', '.join(_REQUIRED_KEYS)})"
        raise UserError(f"body {path}: wanted {wanted}, got a {type(content).__name__}")
    missing = [key for key in _REQUIRED_KEYS if key not in content]
    if missing:
        raise UserError(f"body {path} lacks {', '.join(missing)}; wanted {', '.join(_REQUIRED_KEYS)}")
    arrays = {key: content[key] for key in _KEYS if key in content}
    for key, array in arrays.items():
        if key == "joint_names" or (key == "J_regressor" and isinstance(array, SparseMatrix)):
            continue
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
            raise UserError(f"body {path}: {key}: wanted finite numbers, got others; copy or download the file again")
    return arrays


def _check_shapes(arrays: dict[str, Any], path: Path) -> tuple[int, int]:
    """Check every shape that has only one layout, make the joint regressor dense, and return V and J."""
    vertices, joints = arrays["v_template"].shape[:1], arrays["weights"].shape[1:2]
    components = arrays["shapedirs"].shape[2:3] or ("S",)
    wanted: dict[str, tuple[int | str, ...]] = {
        "v_template": (*vertices, 3),
        "f": (*arrays["f"].shape[:1], 3),
        "weights": (*vertices, *joints) if vertices and joints else ("V", "J"),
        "J_regressor": (*joints, *vertices),
        "kintree_table": (2, *joints),
        "shapedirs": (*vertices, 3, *components),
    }
    for key, shape in wanted.items():
        if tuple(arrays[key].shape) != shape:
            got, expected = (str(list(s)).replace("'", "") for s in (arrays[key].shape, shape))
            raise UserError(f"body {path}: {key}: wanted shape {expected}, got {got}; get another copy")
    if not vertices[0] or not 0 < joints[0] <= MAX_JOINTS:
        wanted_counts = f"at least 1 vertex and 1 to {MAX_JOINTS:,} joints"
        raise UserError(f"body {path}: wanted {wanted_counts}, got {vertices[0]} and {joints[0]}; get another copy")
    if isinstance(arrays["J_regressor"], SparseMatrix):
        arrays["J_regressor"] = arrays["J_regressor"].toarray()
    return vertices[0], joints[0]


def _parents(table: NDArray, path: Path) -> tuple[int, ...]:
    """Return the parent of each joint; SMPL stores -1, that of the root, as an unsigned 32-bit integer."""
    if not np.isfinite(table).all() or (table[0] != np.round(table[0])).any():
        raise UserError(f"body {path}: kintree_table: wanted indices of joints, got others; copy or download the file again")
    parents = [int(parent) for parent in table[0]]
    parents = [-1 if parent in (2**32 - 1, 2**64 - 1) else parent for parent in parents]
    if parents[0] != -1:
        raise UserError(
            f"body {path}: kintree_table: wanted -1 (root) as parent of joint 0, got {parents[0]}; get another copy"
        )
    for joint, parent in enumerate(parents[1:], 1):
        if not 0 <= parent < joint:
            reason = "which does not come before it" if 0 <= parent < len(parents) else "which does not exist"
            raise UserError(f"body {path}: kintree_table: parent of joint {joint} is {parent}, {reason}; get another copy")
    return tuple(parents)


def _faces(array: NDArray, vertices: int, path: Path) -> NDArray[np.int64]:
    wrong = UserError(
        f"body {path}: f: wanted triangles of vertex indices from 0 to {vertices - 1}, got others; get another copy"
    )
    if not len(array) or not (array >= 0).all() or not (array < vertices).all():  # NaN fails both
        raise wrong
    faces = array.astype(np.int64)
    if (faces != array).any():
        raise wrong
    return faces


def _pose_directions(array: NDArray, vertices: int, values: int, path: Path) -> NDArray:
    """Return the pose correctives as [V, 3, P] from any of the usual layouts."""
    rows = 3 * vertices
    if array.shape == (vertices, 3, values):
        return array
    if array.ndim == 2 and sorted(array.shape) == sorted((rows, values)):
        if rows == values:
            raise UserError(f"body {path}: posedirs: shape {list(array.shape)} is ambiguous; store it as [V, 3, P]")
        return (array if array.shape[0] == rows else array.T).reshape(vertices, 3, values)
    raise UserError(f"body {path}: posedirs: wanted shape [{vertices}, 3, {values}], got {list(array.shape)}; get another copy")


def _names(names: Any, joints: int) -> tuple[str, ...]:
    """Return the names in the file if they are valid, else those of the model with as many joints, else `joint_N`."""
    if isinstance(names, np.ndarray) and names.dtype.kind == "U" and names.size == joints:
        found = [str(name) for name in names.ravel() if name.isprintable()] if _is_text(names) else []
        if len(set(found)) == joints:
            return tuple(found)
    return _JOINT_NAMES.get(joints) or tuple(f"joint_{joint}" for joint in range(joints))


def _is_text(array: NDArray) -> bool:
    """Return whether every character is valid; NumPy and Python fail in odd ways on code points beyond Unicode."""
    letters = np.ascontiguousarray(array).view(np.uint32)
    return bool((letters if array.dtype.isnative else letters.byteswap()).max(initial=0) <= 0x10FFFF)


def _tensor(array: NDArray, dtype: torch.dtype, subject: str) -> Tensor:
    # Always a copy: tensors are writable, contiguous, and do not keep a larger array in memory.
    with np.errstate(over="ignore"):
        tensor = torch.from_numpy(np.array(array, np.float64 if dtype == torch.float64 else np.float32, order="C"))
    if not torch.isfinite(tensor).all():
        raise UserError(f"{subject}: wanted finite numbers, got others; copy or download the file again")
    return tensor
