"""Reading SMPL, SMPL-H and SMPL-X bodies from the files that their authors give out, and bodies of other skeletons alike."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import torch
from numpy.typing import NDArray
from torch import Tensor

from snarfcli.bodies.body import Body
from snarfcli.bodies.skeleton import SMPL_JOINT_NAMES, SMPLH_JOINT_NAMES, SMPLX_JOINT_NAMES
from snarfcli.errors import UserError
from snarfcli.files import read_npz
from snarfcli.formats.pickles import read_pickle

__all__ = ["load_body"]

log = logging.getLogger(__name__)

_REQUIRED_KEYS = ("v_template", "f", "weights", "J_regressor", "kintree_table", "shapedirs")
_KEYS = (*_REQUIRED_KEYS, "posedirs", "joint_names")
_JOINT_NAMES = {len(names): names for names in (SMPL_JOINT_NAMES, SMPLH_JOINT_NAMES, SMPLX_JOINT_NAMES)}
_MAX_JOINTS = 1000
_MAX_SHAPES = 300  # of SMPL v1.1.0 and SMPL-X
# Components of SMPL-X files, shape first and expression after it; smplx 0.1.28 cuts them at the same places.
_SHAPES_OF_SMPLX = {20: 10, 400: 300}
# Weights are blended as they are. Stored as float16, the rows of four weights sum to 1 within 1e-3.
_ROW_SUM_TOLERANCE = 1e-2


def load_body(path: str | Path, *, dtype: torch.dtype = torch.float32, num_betas: int | None = None) -> Body:
    """Read an SMPL-format body: SMPL v1.0.0 and v1.1.0, SMPL-H, SMPL-X, MANO, SMAL, `.npz` or `.pkl`.

    Pickles are read as they are downloaded: neither chumpy nor Python 2 is needed, and nothing in them is executed.

    Args:
        path: file with the arrays v_template, f, weights, J_regressor, kintree_table and shapedirs, named and shaped as in
            SMPL. `posedirs` may be [V, 3, P], [3V, P] or [P, 3V], or missing: the body then has no pose correctives.
            `joint_names` is optional. Expressions, textures and hand components are left out.
        dtype: float32 or float64.
        num_betas: how many shape parameters to keep, at most; all by default, which are up to 300. Posing costs in proportion
            to the betas that are given, memory in proportion to those that are kept.

    Raises:
        UserError: the file is missing, damaged or of another kind, lacks an array, or its arrays do not fit together.
        ValueError: num_betas is negative.
    """
    path = Path(path)
    if num_betas is not None and num_betas < 0:
        raise ValueError(f"num_betas: wanted at least 0, got {num_betas}")
    arrays = _arrays(path)
    vertices, joints = _check_shapes(arrays, path)
    parents = _parents(arrays["kintree_table"], path)
    faces = _faces(arrays["f"], vertices, path)
    shapes = min(arrays["shapedirs"].shape[2], _MAX_SHAPES)
    if joints == len(SMPLX_JOINT_NAMES):
        shapes = _SHAPES_OF_SMPLX.get(arrays["shapedirs"].shape[2], shapes)
    arrays["shapedirs"] = arrays["shapedirs"][:, :, : shapes if num_betas is None else min(shapes, num_betas)]
    if "posedirs" in arrays:
        arrays["posedirs"] = _pose_directions(arrays["posedirs"], vertices, 9 * (joints - 1), path)
    else:
        log.info("%s: has no posedirs; the body is posed without pose correctives", path.name)
        arrays["posedirs"] = np.zeros((vertices, 3, 0))

    def tensor(key: str) -> Tensor:
        return _tensor(arrays.pop(key), dtype, f"body {path}: {key}")  # pop: what is converted is not kept twice

    weights = tensor("weights")
    error = (weights.double().sum(1) - 1).abs().max().item()
    if error > _ROW_SUM_TOLERANCE:
        raise UserError(f"body {path}: weights of a vertex must sum to 1, and one is off by {error:.3g}; get another copy")
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
        # SMPL-X's archives hold pickled dictionaries too, which are not looked at.
        content = read_npz(path, "body", only=_KEYS)
    elif kind in (".pkl", ".pickle"):
        content = read_pickle(path, "body")
    else:
        raise UserError(f"body {path} is neither an .npz nor a .pkl file; name a body in SMPL's format")
    if not isinstance(content, dict):
        raise UserError(f"body {path} holds a {type(content).__name__}; wanted named arrays ({', '.join(_REQUIRED_KEYS)})")
    missing = [key for key in _REQUIRED_KEYS if key not in content]
    if missing:
        raise UserError(f"body {path} lacks {', '.join(missing)}; an SMPL-format body has {', '.join(_REQUIRED_KEYS)}")
    arrays = {key: content[key] for key in _KEYS if key in content}
    for key, array in arrays.items():
        if key == "joint_names" or (key == "J_regressor" and scipy.sparse.issparse(array)):
            continue
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
            raise UserError(f"body {path}: {key} must hold finite numbers; copy or download the file again")
    return arrays


def _check_shapes(arrays: dict[str, Any], path: Path) -> tuple[int, int]:
    """Check every shape that has one form only, make the joint regressor dense, and return V and J."""
    vertices, joints = arrays["v_template"].shape[:1], arrays["weights"].shape[1:2]
    components = arrays["shapedirs"].shape[2:3] or ("S",)
    wanted = {
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
            raise UserError(f"body {path}: {key} has shape {got}, wanted {expected}")
    if not vertices[0] or not 0 < joints[0] <= _MAX_JOINTS:
        got = f"{vertices[0]} vertices and {joints[0]} joints"
        raise UserError(f"body {path} has {got}; wanted some of both, and at most {_MAX_JOINTS:,} joints")
    if scipy.sparse.issparse(arrays["J_regressor"]):
        arrays["J_regressor"] = arrays["J_regressor"].toarray()
    return vertices[0], joints[0]


def _parents(table: NDArray, path: Path) -> tuple[int, ...]:
    """Return each joint's parent; SMPL stores the root's, -1, as an unsigned number of 32 bits."""
    if not np.isfinite(table).all() or (table[0] != np.round(table[0])).any():
        raise UserError(f"body {path}: kintree_table must hold joint numbers; copy or download the file again")
    parents = [int(parent) for parent in table[0]]
    parents = [-1 if parent in (2**32 - 1, 2**64 - 1) else parent for parent in parents]
    if parents[0] != -1:
        raise UserError(f"body {path}: kintree_table names {parents[0]} as parent of joint 0, which must be the root (-1)")
    for joint, parent in enumerate(parents[1:], 1):
        if not 0 <= parent < joint:
            reason = "which does not come before it" if 0 <= parent < len(parents) else "which does not exist"
            raise UserError(f"body {path}: kintree_table names {parent} as parent of joint {joint}, {reason}")
    return tuple(parents)


def _faces(array: NDArray, vertices: int, path: Path) -> NDArray[np.int64]:
    wrong = UserError(f"body {path}: f must hold triangles of vertex numbers from 0 to {vertices - 1}")
    if not len(array) or not (array >= 0).all() or not (array < vertices).all():  # NaN is neither
        raise wrong
    faces = array.astype(np.int64)
    if (faces != array).any():
        raise wrong
    return faces


def _pose_directions(array: NDArray, vertices: int, values: int, path: Path) -> NDArray:
    """Return the pose correctives as [V, 3, P] from any of the layouts in use."""
    rows = 3 * vertices
    if array.shape == (vertices, 3, values):
        return array
    if array.ndim == 2 and sorted(array.shape) == sorted((rows, values)):
        if rows == values:
            raise UserError(f"body {path}: posedirs has shape {list(array.shape)}, which is ambiguous; store it as [V, 3, P]")
        return (array if array.shape[0] == rows else array.T).reshape(vertices, 3, values)
    raise UserError(f"body {path}: posedirs has shape {list(array.shape)}, wanted [{vertices}, 3, {values}]")


def _names(names: Any, joints: int) -> tuple[str, ...]:
    """Return the names in the file if they are sound, else those of the model with so many joints, else made-up ones."""
    if isinstance(names, np.ndarray) and names.dtype.kind == "U" and names.size == joints:
        found = [str(name) for name in names.ravel() if name.isprintable()] if _is_text(names) else []
        if len(set(found)) == joints:
            return tuple(found)
    return _JOINT_NAMES.get(joints) or tuple(f"joint_{joint}" for joint in range(joints))


def _is_text(array: NDArray) -> bool:
    """Whether every letter is one: NumPy and Python fail in odd ways on numbers beyond Unicode."""
    letters = np.ascontiguousarray(array).view(np.uint32)
    return bool((letters if array.dtype.isnative else letters.byteswap()).max(initial=0) <= 0x10FFFF)


def _tensor(array: NDArray, dtype: torch.dtype, subject: str) -> Tensor:
    # A copy in any case: tensors are writable, contiguous, and do not keep a larger array alive.
    with np.errstate(over="ignore"):
        tensor = torch.from_numpy(np.array(array, np.float64 if dtype == torch.float64 else np.float32, order="C"))
    if not torch.isfinite(tensor).all():
        raise UserError(f"{subject} must hold finite numbers; copy or download the file again")
    return tensor
