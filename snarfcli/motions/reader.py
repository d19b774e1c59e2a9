"""Read motion files of all supported formats."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton, legs_apart_pose
from snarfcli.errors import UserError
from snarfcli.files import read_npy, read_npz
from snarfcli.formats.bvh import read_bvh
from snarfcli.formats.gltf import GLTF_SUFFIXES, read_gltf
from snarfcli.formats.pickles import read_pickle
from snarfcli.formats.rig import Rig
from snarfcli.motions.anatomy import JOINTS_REST, PARENTS
from snarfcli.motions.arrays import MAX_POSE_BYTES, POSE_KEYS, motion_from_arrays
from snarfcli.motions.layouts import HANDS
from snarfcli.motions.motion import Motion
from snarfcli.motions.retarget import choose_clip, retarget
from snarfcli.motions.rig_rest import check_rest
from snarfcli.motions.up_axis import UPS, Up

__all__ = ["MOTION_SUFFIXES", "RIG_SUFFIXES", "average_skeleton", "read_motion", "read_rig"]

_ARRAY_SUFFIXES = (".npz", ".npy", ".pkl", ".pickle")
RIG_SUFFIXES = (".bvh", *GLTF_SUFFIXES)
"""Suffixes of files with joints of their own, in lower case."""
MOTION_SUFFIXES = (*_ARRAY_SUFFIXES, *RIG_SUFFIXES)
"""Suffixes of supported files, in lower case."""
_MAX_FILES = 100_000  # in a folder with one pose per file: half an hour at 60 frames per second


def read_motion(
    path: str | Path,
    skeleton: Skeleton | None = None,
    *,
    up: Up = "auto",
    hands: str = "rest",
    rest: str = "auto",
    mapping: str | Path | Mapping[str, str | None] | None = None,
    clip: str | int | None = None,
) -> Motion:
    """Read a motion as poses of one skeleton from a file of any supported format.

    | file | content |
    |---|---|
    | `.npz` | AMASS, old and new (SMPL-H, SMPL-X), or plain arrays `poses` or `pose` |
    | `.npy` | poses, one array |
    | `.pkl` | AIST++; nothing in it is executed |
    | folder | one `.npz` per frame with `pose` and optionally `trans` or `transl`, as in CAPE and the papers' demo; 1, 2, 10 |
    | `.bvh`, `.glb`, `.gltf`, `.vrm`, `.vrma` | joints of any program, recognised by name, or by the table of bones of VRM |

    Args:
        path: file or folder.
        skeleton: skeleton of the poses to return; SMPL's 24 joints by default. Arrays are converted between SMPL, SMPL-H and
            SMPL-X joint by joint: hands and face are kept if both have them, else zero. For another kind of skeleton, an array
            has 3 values per joint. Poses of rigs are retargeted by bone directions and the height of the hips.
        up: up axis of the file. `auto`: for arrays, the array `up` ("y" or "z") if present; else z for AMASS, y for AIST++, y
            for other arrays without a translation. Otherwise, and for rigs, the axis along which the body stands. A glTF file
            of the skeleton itself has y up, as the format requires.
        hands: pose of SMPL's two hand joints if an array has fingers instead: `rest`, zero; or `released`, values 66 to 72, as
            in the training data of the released code.
        rest: for rigs, the rest pose that is compared with that of the skeleton. `file`: that of the file; `clip`: the frames
            of the clip, in which no limb is taken to be twisted on average; a number: that frame of the clip, for clips in
            which the person stands in a T- or A-pose for a moment; `auto`: that of the file, and the clip for limbs that do not
            rest as in a standing person (all bones along one axis).
        mapping: for rigs, the joint of the file that moves each joint of the skeleton: {target: source}, or the path of such a
            JSON file. Other joints are mapped by name; null keeps a joint at rest.
        clip: for rigs, name or index of the clip; the first by default.

    Returns:
        The motion in a world with y up, facing as in the file, named after the file.

    Raises:
        UserError: the file is missing, of another kind, damaged, or does not fit the skeleton; the message says why.
        ValueError: `up` or `hands` is unknown.
    """
    if up not in UPS:
        raise ValueError(f"up: wanted 'auto', 'y' or 'z', got {up!r}")
    if hands not in HANDS:
        raise ValueError(f"hands: wanted 'rest' or 'released', got {hands!r}")
    check_rest(rest)
    path = Path(path)
    skeleton = average_skeleton() if skeleton is None else skeleton
    suffix = path.suffix.lower()
    if suffix in RIG_SUFFIXES and not path.is_dir():
        rig = read_rig(path)
        chosen = choose_clip(rig, clip, path)
        name = path.stem if len(rig.clips) == 1 else f"{path.stem}_{chosen.name}"
        return retarget(rig, chosen, skeleton, path=path, name=name, up=up, rest=rest, mapping=mapping)
    for setting, value in (("mapping", mapping), ("clip", clip), ("rest", None if rest == "auto" else rest)):
        if value is not None:
            raise UserError(f"{setting}: wanted a file ending in {', '.join(RIG_SUFFIXES)}, got pose file {path}; leave it out")
    arrays = _read_arrays(path, suffix)
    name = path.name if path.is_dir() else path.stem
    return motion_from_arrays(arrays, skeleton, path, name=name, up=up, hands=hands)


def average_skeleton() -> Skeleton:
    """Return SMPL's 24 joints for an average adult: the skeleton of the built-in motions, and of `read_motion` by default."""
    rest = torch.from_numpy(JOINTS_REST)
    return Skeleton(SMPL_JOINT_NAMES, PARENTS, rest, legs_apart_pose(SMPL_JOINT_NAMES, rest.dtype))


def read_rig(path: str | Path) -> Rig:
    """Read the joints and the clips of a file with joints of its own; see `RIG_SUFFIXES`.

    Raises:
        UserError: the file is missing, of another kind, or damaged.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in RIG_SUFFIXES:
        raise UserError(f"{path}: wanted a file ending in {', '.join(RIG_SUFFIXES)}, which has joints of its own; give another")
    return read_bvh(path) if suffix == ".bvh" else read_gltf(path)


def _read_arrays(path: Path, suffix: str) -> dict[str, NDArray]:
    """Return the arrays of a file or folder, with the names of AMASS and AIST++."""
    if path.is_dir():
        return _read_folder(path)
    if suffix == ".npz":
        return read_npz(path, "pose file", only=POSE_KEYS, max_bytes=MAX_POSE_BYTES)
    if suffix == ".npy":
        return {"poses": read_npy(path, "pose file", max_bytes=MAX_POSE_BYTES)}
    if suffix in (".pkl", ".pickle"):
        return _from_pickle(path)
    if not path.exists():
        raise UserError(f"no pose file at {path}")
    wanted = f"a file ending in {', '.join(MOTION_SUFFIXES)}, or a folder of .npz files"
    raise UserError(f"pose file {path}: wanted {wanted}; convert it")


def _from_pickle(path: Path) -> dict[str, NDArray]:
    content = read_pickle(path, "pose file")
    if not isinstance(content, dict):
        raise UserError(f"pose file {path}: wanted a dict with smpl_poses, as in AIST++, got {type(content).__name__}")
    arrays = {}
    for key in POSE_KEYS:
        value = content.get(key) if key not in ("gender", "up") else None  # these are text
        if isinstance(value, (np.ndarray, int, float)):
            arrays[key] = np.asarray(value)
        elif value is not None:
            raise UserError(f"pose file {path}: {key}: wanted an array, got {type(value).__name__}; repair the file")
    return arrays


def _read_folder(path: Path) -> dict[str, NDArray]:
    """Return the poses of a folder with one file per frame, sorted by the numbers in the file names."""
    try:
        files = [file for file in path.iterdir() if file.suffix.lower() == ".npz" and not file.name.startswith(".")]
    except OSError as error:
        raise UserError(f"folder {path} cannot be read ({error.strerror or error})") from None
    if not files:
        raise UserError(f"folder {path} has no .npz files; give a pose file, or a folder with one per frame")
    if len(files) > _MAX_FILES:
        raise UserError(f"folder {path}: wanted at most {_MAX_FILES} .npz files, got {len(files)}; give a part of them")
    files.sort(key=_natural)
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
    arrays = read_npz(file, "pose file", only=POSE_KEYS, max_bytes=MAX_POSE_BYTES)
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
    return frame | {key: arrays[key] for key in ("mocap_framerate", "mocap_frame_rate", "frame_rate", "fps") if key in arrays}


def _natural(file: Path) -> list[tuple[int, int, str]]:
    """Return a sort key that compares numbers in names by value."""
    parts = re.split(r"([0-9]+)", file.name)
    return [(1, int(part), part) if at % 2 else (0, 0, part) for at, part in enumerate(parts)]
