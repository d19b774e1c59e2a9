"""The files that `snarf fit` writes beside the scans: the skeleton, and the poses of each sequence.

Both are files of `datasets/skeleton_files.py` with more entries: what made them, so that they are never mixed up with files of
others, and what is needed to go on after an interruption.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.array_files import read_npz
from snarfcli.bodies import Skeleton
from snarfcli.datasets.mesh_folders import POSE_FILES, skeleton_files
from snarfcli.datasets.recorded_sequence import FileToWorld
from snarfcli.errors import UserError
from snarfcli.files import write_arrays
from snarfcli.scanned_subjects.surroundings import AXES
from snarfcli.texts import one_line

__all__ = [
    "LONGEST_REASON",
    "MADE_BY",
    "FitMade",
    "FittedFile",
    "foreign_files",
    "own_poses",
    "read_fitted",
    "read_made",
    "remove_replaced",
    "write_fitted",
    "write_skeleton",
]

Array = NDArray[np.float64]

MADE_BY = "snarf fit"
"""Entry of the files."""
LONGEST_REASON = 200
"""Letters of a reason why a frame is not trusted."""
_MAX_BYTES = 2**29
_LARGEST = 1e9  # number in a file that is not damaged
_SKELETON, _POSES = "skeleton.npz", "poses.npz"


@dataclass(frozen=True)
class FitMade:
    """What is decided once for a subject, as the skeleton file keeps it."""

    betas: Array
    """[S], shape parameters."""
    world: FileToWorld
    """Unit and axes of the files."""
    settings: Mapping[str, Any]
    """Settings that the poses depend on."""
    size: float = 1.0
    """Factor by which a rig is made larger, see `BodyChoice`."""

    @property
    def digest(self) -> str:
        """Tells poses of this fit from those of another one."""
        content = [*np.asarray(self.betas).tolist(), self.world.scale, self.world.up, self.settings, self.size]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class FittedFile:
    """The poses of one sequence, metres and y up."""

    poses: Array
    """[T, J, 3], axis-angle, radians."""
    translation: Array
    """[T, 3], metres."""
    residual_m: Array
    """[T], mean distance between body and scan, metres; NaN for a frame that could not be read."""
    is_trusted: NDArray[np.bool_]
    """[T]."""
    reasons: tuple[str, ...]
    """Per frame, why it is not trusted; empty for frames that are."""
    unseen: NDArray[np.bool_]
    """[T, J], joints that the scan does not show; their rotations are what is usual."""
    source: str
    """Digest of names and contents of the scans."""
    seconds: float
    """Processor time of the fit."""


def foreign_files(place: Path, folders: Sequence[Path]) -> list[Path]:
    """Return the skeleton files in the folder of a subject, and the pose files in some of its folders, of others."""
    candidates = skeleton_files(place)
    candidates += [folder / name for folder in folders for name in POSE_FILES if (folder / name).is_file()]
    return [path for path in dict.fromkeys(candidates) if not _is_own(path)]


def own_poses(folders: Sequence[Path]) -> list[Path]:
    """Return the pose files that `snarf fit` has written in some folders."""
    return [path for path in (folder / _POSES for folder in folders) if path.is_file() and _is_own(path)]


def write_skeleton(place: Path, skeleton: Skeleton, made: FitMade) -> None:
    """Write the skeleton of a subject, whole or not at all."""
    world = made.world
    arrays = {
        "names": np.array(skeleton.names),
        "parents": np.array(skeleton.parents, np.int64),
        "joints_rest": _file_points(skeleton.joints_rest.double().numpy(), world),
        "canonical_pose": skeleton.canonical_pose.double().numpy() @ world.turn,
        "up": np.array(world.up),
        "scale": np.array(world.scale),
        "betas": np.asarray(made.betas, np.float64),
        "size": np.array(made.size),
        "settings": np.array(json.dumps(made.settings, sort_keys=True)),
        "made_by": np.array(MADE_BY),
    }
    write_arrays(place / _SKELETON, arrays)


def read_made(place: Path) -> FitMade | None:
    """Return what an earlier fit has decided; None if there was none, or its file is damaged."""
    path = place / _SKELETON
    if not path.is_file() or not _is_own(path):
        return None
    try:
        arrays = read_npz(path, "skeleton file", max_bytes=_MAX_BYTES)
        world = FileToWorld(float(arrays["scale"]), str(arrays["up"]))
        settings, betas = json.loads(str(arrays["settings"])), np.asarray(arrays["betas"], np.float64)
        made = FitMade(betas, world, settings, float(arrays["size"]))
    except (UserError, KeyError, ValueError, TypeError, OverflowError, RecursionError):
        return None
    numbers = np.array([*betas.reshape(-1), world.scale, made.size])
    is_whole = betas.ndim == 1 and (np.abs(numbers) < _LARGEST).all() and min(world.scale, made.size) > 0 and world.up in AXES
    return made if is_whole and isinstance(settings, dict) else None


def write_fitted(folder: Path, fitted: FittedFile, made: FitMade, frame_rate: float) -> None:
    """Write the poses of one sequence, whole or not at all, in the units and axes of its scans."""
    world = made.world
    arrays = {
        "poses": fitted.poses @ world.turn,
        "trans": _file_points(fitted.translation, world),
        "rest_up": np.array(world.up),  # for readers that do not read the skeleton beside them
        "metres_per_unit": np.array(world.scale),
        "frame_rate": np.array(frame_rate),
        "trusted": fitted.is_trusted,
        "residual_m": fitted.residual_m,
        "reasons": np.array(fitted.reasons, np.str_),
        "unseen": fitted.unseen,
        "source": np.array(fitted.source),
        "seconds": np.array(fitted.seconds),
        "fit": np.array(made.digest),
        "made_by": np.array(MADE_BY),
    }
    write_arrays(folder / _POSES, arrays)


def read_fitted(folder: Path, made: FitMade, joints: int) -> FittedFile | None:
    """Return the poses of a number of joints that this fit has written for a sequence; None without any, or if damaged."""
    path = folder / _POSES
    if not path.is_file() or not _is_own(path):
        return None
    try:
        arrays = read_npz(path, "pose file", max_bytes=_MAX_BYTES)
        if str(arrays["fit"]) != made.digest:
            return None
        fitted = FittedFile(
            made.world.angles(arrays["poses"]),
            made.world.points(arrays["trans"]),
            np.asarray(arrays["residual_m"], np.float64),
            np.asarray(arrays["trusted"], bool),
            tuple(one_line(str(reason), LONGEST_REASON) for reason in arrays["reasons"]),
            np.asarray(arrays["unseen"], bool),
            str(arrays["source"]),
            float(arrays["seconds"]),
        )
    except (UserError, KeyError, ValueError, TypeError, OverflowError):
        return None
    frames = len(fitted.reasons)
    shapes = [one.shape for one in (fitted.poses, fitted.translation, fitted.residual_m, fitted.is_trusted, fitted.unseen)]
    wanted = [(frames, joints, 3), (frames, 3), (frames,), (frames,), (frames, joints)]
    is_whole = np.isfinite(fitted.residual_m).any() and shapes == wanted
    numbers = [fitted.poses, fitted.translation, np.nan_to_num(fitted.residual_m, nan=0.0, posinf=np.inf), fitted.seconds]
    return fitted if is_whole and all((np.abs(array) < _LARGEST).all() for array in numbers) else None


def remove_replaced(place: Path, folders: Sequence[Path]) -> None:
    """Delete the files of others, see `foreign_files`, which those of the fit replace."""
    for path in foreign_files(place, folders):
        path.unlink(missing_ok=True)


def _file_points(points: Array, world: FileToWorld) -> Array:
    """Return points or offsets [..., 3] in units and axes of the files."""
    return np.asarray(points, np.float64) @ world.turn / world.scale


def _is_own(path: Path) -> bool:
    """Return whether `snarf fit` has written a file."""
    if path.suffix != ".npz":
        return False
    try:
        return str(read_npz(path, "file", only=["made_by"]).get("made_by")) == MADE_BY
    except UserError:
        return False
