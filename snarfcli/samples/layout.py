"""The files of processed samples, and how they are opened and checked.

The folder of a subject `{root}/processed/{data}/{subject}` contains

    manifest.json                      origin, settings, versions, counts, checksums; written last
    subject.npz                        skeleton; mesh in the canonical pose, if the data set has one
    {train,test,ood}/{sequence}/
        points.npy       [T, P, 3]     uint16, quantised in the sampling cube of the frame
        occupancies.npy  [T, P / 8]    uint8, one bit per point, most significant first
        vertices.npy     [sum V]       uint64, vertices of the posed meshes, 21 bits per axis, one frame after the other
        faces.npy        [sum F, 3]    int32, faces of each topology that occurs
        frames.npz                     poses, bone transforms, joints, cubes, boxes, start of each mesh
        sequence.json                  settings, counts, checksums; a sequence without it does not exist
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.array_files import map_npy, read_npz
from snarfcli.errors import UserError
from snarfcli.files import file_digest

__all__ = [
    "FORMAT_VERSION",
    "SEQUENCE_FILES",
    "check_digest",
    "check_format",
    "check_sizes",
    "checked_array",
    "open_array",
    "read_arrays",
    "repair_advice",
    "samples_folder",
]

FORMAT_VERSION = 2
"""Raised whenever samples of another version could be misread."""

SEQUENCE_FILES = ("points.npy", "occupancies.npy", "vertices.npy", "faces.npy", "frames.npz")
"""Files of a sequence besides its description."""


def samples_folder(root: str | Path, data: str, subject: str) -> Path:
    """Return the folder of the samples of one subject."""
    return Path(root) / "processed" / data / subject


def check_format(description: Any, folder: Path) -> None:
    """Check the format version of a manifest or of the description of a sequence.

    Raises:
        UserError: the version differs, or there is none.
    """
    version = description.get("format_version") if isinstance(description, dict) else None
    if type(version) is not int or version != FORMAT_VERSION:
        came = version if type(version) is int and abs(version) < 2**63 else "none"
        raise UserError(
            f"the samples in {folder}: wanted format version {FORMAT_VERSION}, got {came}; "
            'make them again: "snarf preprocess ... overwrite=true"'
        )


def repair_advice(folder: Path) -> str:
    """Return the next step for damaged samples, for messages."""
    return f'delete {folder} or run "snarf preprocess" again with overwrite=true'


def check_digest(path: Path, digest: str) -> None:
    """Compare a file with the checksum that was written with it.

    Raises:
        UserError: they differ.
    """
    if file_digest(path) != digest:
        raise UserError(f"{path} is damaged (its checksum differs); {repair_advice(path.parent)}")


def check_sizes(folder: Path, files: dict[str, dict[str, Any]]) -> None:
    """Check that files exist and have the sizes with which they were written.

    Args:
        folder: their folder.
        files: per file, its entry in a manifest or description.

    Raises:
        UserError: one does not.
    """
    for name, entry in files.items():
        path = folder / name
        size = path.stat().st_size if path.exists() else None
        if size != entry["bytes"]:
            problem = "is missing" if size is None else f"wanted {entry['bytes']} bytes, got {size}"
            raise UserError(f"the samples are damaged: {path} {problem}; {repair_advice(folder)}")


def open_array(path: Path, shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """Memory-map a `.npy` file.

    Raises:
        UserError: it is damaged, or has another shape or type.
        OSError: the system cannot read it.
    """
    try:
        return map_npy(path, shape, dtype)
    except UserError as error:
        reason = str(error).partition("; ")[0]  # without its advice
        raise UserError(f"the samples are damaged: {reason}; {repair_advice(path.parent)}") from None


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read an `.npz` archive of the samples.

    Raises:
        UserError: it is damaged.
        OSError, MemoryError: the system cannot read it.
    """
    try:
        return read_npz(path)
    except UserError as error:
        reason = str(error).rpartition("; ")[0] or error  # without its advice
        raise UserError(f"the samples are damaged: {reason}; {repair_advice(path.parent)}") from None


def checked_array(
    arrays: Mapping[str, np.ndarray], name: str, dtype: type, shape: tuple[int | None, ...], *, least: float | None = None
) -> np.ndarray:
    """Return an array of an archive, if it has the type and shape with which it is written and finite values.

    Args:
        arrays: of the archive.
        name: of the array.
        dtype: its type.
        shape: its shape; None for any length.
        least: minimum of its values; None for any.

    Raises:
        KeyError, ValueError: it does not.
    """
    array = arrays[name]
    is_fitting = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if array.dtype != dtype or not is_fitting:
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{name}: wanted {np.dtype(dtype)} [{wanted}], got {array.dtype} {list(array.shape)[:9]}")
    if not np.isfinite(array).all() or (least is not None and array.size and array.min() < least):
        raise ValueError(f"{name}: wanted finite numbers{'' if least is None else f' from {least:g}'}, got others")
    return array
