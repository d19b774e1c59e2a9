"""Read the content of pose files, of any of their formats, as dictionaries, lists and arrays; nothing in them is executed."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.array_files import list_npz, read_npy, read_npz
from snarfcli.errors import UserError
from snarfcli.formats.pickle_tree import PickleError
from snarfcli.formats.pickles import estimate_of, read_estimate
from snarfcli.formats.torch_files import read_torch
from snarfcli.motions.pose_keys import CONTAINER_KEYS, FRAME_RATES, listed_keys, role_of
from snarfcli.motions.pose_sets import PoseSet, find_sets, without_unread

__all__ = ["POSE_SUFFIXES", "read_pose_sets"]

_MAX_BYTES = 2**28  # of the arrays of a pose file, as stored
_MAX_FILES = 100_000  # in a folder with one pose per file: half an hour at 60 frames per second
_PICKLES = (".pkl", ".pickle", ".joblib")
_TORCH = (".pt", ".pth")
POSE_SUFFIXES = (".npz", ".npy", *_PICKLES, *_TORCH)
"""Suffixes of files with pose arrays, in lower case."""
_READABLE = (
    "give a file with poses (AMASS, CAPE, AIST++, WHAM), fullpose (MoSh++), global_orient and body_pose (smplx, GVHMR, ROMP,"
    " 4D-Humans), or pred_global_rots and pred_joint_coords (SAM 3D Body)"
)


def read_pose_sets(path: Path) -> list[PoseSet]:
    """Return the sets of pose arrays in a file or folder, the preferred first; at least one.

    Args:
        path: a file with a suffix of `POSE_SUFFIXES`, or a folder with one file per frame.

    Raises:
        UserError: the file is missing, damaged or too large, or has no poses; the message lists what it has.
    """
    content = _folder_content(path) if path.is_dir() else _content(path)
    sets = find_sets(content)
    if not sets:
        raise UserError(f"pose file {path}: wanted 'poses', got {_what_there_is(content)}; {_READABLE}")
    return sets


def _what_there_is(content: Any) -> str:
    """Return the names of the arrays in the content, for a message."""
    names: list[object] = []
    nodes = [(content, 0)]
    while nodes and len(names) < 100:
        node, depth = nodes.pop(0)
        if isinstance(node, dict):
            names += node
        if isinstance(node, (dict, list, tuple)) and depth < 4:
            nodes += [(child, depth + 1) for child in [*(node.values() if isinstance(node, dict) else node)][:20]]
    return listed_keys(dict.fromkeys(names)) or "no named arrays"


def _content(path: Path) -> Any:
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return _npz_content(path)
    if suffix == ".npy":
        array = read_npy(path, "pose file", max_bytes=_MAX_BYTES, objects=_unpickler(path))
        return {"poses": array} if array.dtype != object else _unboxed(array)
    if suffix in _TORCH:
        return read_torch(path, "pose file")
    return read_estimate(path, "pose file")


def _npz_content(path: Path) -> dict[str, Any]:
    """Return the arrays of an `.npz` file that are read; others are only named, so that their content cannot matter."""
    names = dict.fromkeys(list_npz(path, "pose file"))
    wanted = [name for name in names if role_of(name) is not None or name in CONTAINER_KEYS]
    arrays = read_npz(path, "pose file", only=wanted, max_bytes=_MAX_BYTES, objects=_unpickler(path))
    return {**names, **{name: _unboxed(array) if array.dtype == object else array for name, array in arrays.items()}}


def _unpickler(path: Path) -> Callable[[bytes], Any]:
    def unpickle(data: bytes) -> Any:
        try:
            return estimate_of(data, path)
        except PickleError as error:
            raise UserError(f"pose file {path} {error}") from None

    return unpickle


def _unboxed(array: NDArray) -> Any:
    """Return the object in an array of objects; NumPy wraps a dictionary in an array without axes."""
    value = array.item()
    return value[0] if isinstance(value, list) and len(value) == 1 else value


def _folder_content(path: Path) -> dict[str, Any]:
    """Return the content of a folder with one file per frame, sorted by the numbers in the file names."""
    try:
        files = [file for file in path.iterdir() if not file.name.startswith(".")]
    except OSError as error:
        raise UserError(f"folder {path} cannot be read ({error.strerror or error})") from None
    suffix = next((suffix for suffix in POSE_SUFFIXES if any(file.suffix.lower() == suffix for file in files)), None)
    files = [file for file in files if suffix is not None and file.suffix.lower() == suffix]
    if not files:
        wanted = ", ".join(POSE_SUFFIXES)
        raise UserError(f"folder {path} has no files ending in {wanted}; give a pose file, or a folder with one per frame")
    if len(files) > _MAX_FILES:
        raise UserError(f"folder {path}: wanted at most {_MAX_FILES} {suffix} files, got {len(files)}; give a part of them")
    files.sort(key=_natural)
    if suffix == ".npz" and {"pose", "poses"} & {*list_npz(files[0], "pose file")}:
        return _joined_frames(files)
    return {file.name: without_unread(_content(file)) for file in files}


def _joined_frames(files: list[Path]) -> dict[str, NDArray]:
    """Return the poses of files with one pose each, as in CAPE; all have the same arrays in the same shapes."""
    frames = [_read_frame(file) for file in files]
    arrays: dict[str, NDArray] = {}
    for key in dict.fromkeys(key for frame in frames for key in frame):
        first = next(frame[key] for frame in frames if key in frame)
        for file, frame in zip(files, frames, strict=True):
            if key not in frame or frame[key].shape != first.shape:
                raise UserError(f"pose file {file}: {key} is missing or has another shape than in other files; repair it")
        arrays[key] = np.stack([frame[key] for frame in frames]) if key in ("pose", "trans") else first
    return arrays


def _read_frame(file: Path) -> dict[str, NDArray]:
    """Return `pose` [values] of one file and, if present, `trans` [3] and a frame rate."""
    names = ("pose", "poses", "trans", "transl", *FRAME_RATES)
    arrays = read_npz(file, "pose file", only=names, max_bytes=_MAX_BYTES)
    frame = {}
    for name, keys in (("pose", ("pose", "poses")), ("trans", ("trans", "transl"))):
        key = next((key for key in keys if key in arrays), None)
        if key is None:
            continue
        array = arrays[key]
        if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
            raise UserError(f"pose file {file}: {key}: wanted finite numbers, got others; repair or remove the file")
        if name == "pose" and (array.size > 3 * 1000 or (array.ndim > 1 and array.shape[0] > 1 and array.shape[1] != 3)):
            raise UserError(f"pose file {file}: wanted one pose, got more; name a file, or a folder with one pose per file")
        frame[name] = array.ravel()
    if "pose" not in frame:
        raise UserError(f"pose file {file} has no 'pose'; add it to every .npz file of the folder")
    return frame | {key: arrays[key] for key in FRAME_RATES if key in arrays}


def _natural(file: Path) -> list[tuple[int, int, str]]:
    """Return a sort key that compares numbers in names by value."""
    parts = re.split(r"([0-9]+)", file.name)
    return [(1, int(part), part) if at % 2 else (0, 0, part) for at, part in enumerate(parts)]
