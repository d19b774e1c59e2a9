"""Read motion files of all supported formats."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import torch

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton, legs_apart_pose
from snarfcli.errors import UserError
from snarfcli.formats.bvh import read_bvh
from snarfcli.formats.gltf import GLTF_SUFFIXES, read_gltf
from snarfcli.formats.rig import Rig
from snarfcli.motions.anatomy import JOINTS_REST, PARENTS
from snarfcli.motions.arrays import motion_from_arrays
from snarfcli.motions.layouts import HANDS
from snarfcli.motions.mhr_motion import retarget_mhr
from snarfcli.motions.motion import Motion
from snarfcli.motions.pose_files import POSE_SUFFIXES, read_pose_sets
from snarfcli.motions.pose_sets import choose_set
from snarfcli.motions.retarget import Retargeted, choose_clip, retarget_rig
from snarfcli.motions.rig_rest import check_rest
from snarfcli.motions.up_axis import UPS, Up

__all__ = [
    "MOTION_SUFFIXES",
    "RIG_SUFFIXES",
    "average_skeleton",
    "motion_name",
    "read_motion",
    "read_motion_and_source",
    "read_rig",
]

RIG_SUFFIXES = (".bvh", *GLTF_SUFFIXES)
"""Suffixes of files with joints of their own, in lower case."""
MOTION_SUFFIXES = (*POSE_SUFFIXES, *RIG_SUFFIXES)
"""Suffixes of supported files, in lower case."""
_SAME_NAMES = ("poses", "motion")  # of the pose files of `data=meshes`: the folder has the name of the sequence
_RIGS = f"a file ending in {', '.join(RIG_SUFFIXES)}"


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
    | `.npz`, `.npy`, `.pkl`, `.pt` | arrays of poses in any of these forms; nothing in the files is executed |
    | AMASS, old and new | `poses` (SMPL-H, SMPL-X), or `root_orient` and `pose_body`; MoSh++, MOYO: `fullpose` |
    | plain, CAPE, AIST++ | `poses` or `pose`: axis-angle or rotation matrices |
    | smplx, ROMP, 4D-Humans, GVHMR | `global_orient` and `body_pose`, and fingers and face if present |
    | WHAM, TRAM, EasyMocap | `pose_world` and `pose`; `pred_rotmat`; `poses` with `Rh` and `Th` |
    | SAM 3D Body | `pred_global_rots` and `pred_joint_coords`: joints of MHR, retargeted as those of a rig |
    | folder | one such file per frame: 1, 2, 10 |
    | `.bvh`, `.glb`, `.gltf`, `.vrm`, `.vrma` | joints of any program, recognised by name, or by the table of bones of VRM |

    Args:
        path: file or folder.
        skeleton: skeleton of the poses to return; SMPL's 24 joints by default. Arrays are converted between SMPL, SMPL-H and
            SMPL-X joint by joint: hands and face are kept if both have them, else zero. For another kind of skeleton, an array
            has 3 values per joint. Poses of rigs are retargeted by bone directions and the height of the hips.
        up: up axis of the file: y, z, x, or their opposites, such as -y for the frame of a camera. `auto`: for arrays, the text
            `up` if present, and the axes in which the skeleton rests for poses of `snarf fit`; else z for AMASS, y for AIST++
            and GVHMR, y for other arrays without a translation. Otherwise, and for rigs, the axis y or z along which the body
            stands. -y if a body hangs head down along y during the whole clip.
            A glTF file of the skeleton itself has y up, as the format requires.
        hands: pose of SMPL's two hand joints if an array has fingers instead: `rest`, zero; or `released`, values 66 to 72, as
            in the training data of the released code.
        rest: for rigs, the rest pose that is compared with that of the skeleton. `file`: that of the file; `clip`: the frames
            of the clip, in which no limb is taken to be twisted on average; a number: that frame of the clip, for clips in
            which the person stands in a T- or A-pose for a moment; `auto`: that of the file, and the clip for limbs that do not
            rest as in a standing person (all bones along one axis).
        mapping: for rigs and MHR, the joint of the file that moves each joint of the skeleton: {target: source}, or the path of
            such a JSON file. Other joints are mapped by name; null keeps a joint at rest.
        clip: name or index of the clip of a rig; for arrays, of the person, or of world or camera coordinates. By default the
            first clip, or the first person in the world.

    Returns:
        The motion in a world with y up, facing as in the file. Its name is that of the file, or of the folder around a file
        that is called poses or motion.

    Raises:
        UserError: the file is missing, of another kind, damaged, or does not fit the skeleton; the message says why.
        ValueError: `up` or `hands` is unknown.
    """
    given = read_motion_and_source(path, skeleton, up=up, hands=hands, rest=rest, mapping=mapping, clip=clip)
    return given[0]


def read_motion_and_source(
    path: str | Path,
    skeleton: Skeleton | None = None,
    *,
    up: Up = "auto",
    hands: str = "rest",
    rest: str = "auto",
    mapping: str | Path | Mapping[str, str | None] | None = None,
    clip: str | int | None = None,
) -> tuple[Motion, Retargeted | None]:
    """Return the motion of `read_motion`, and the joints of the file beside it; None for poses without joints of their own."""
    if up not in UPS:
        raise ValueError(f"up: wanted one of {', '.join(UPS)}, got {up!r}")
    if hands not in HANDS:
        raise ValueError(f"hands: wanted 'rest' or 'released', got {hands!r}")
    check_rest(rest)
    path = Path(path)
    skeleton = average_skeleton() if skeleton is None else skeleton
    suffix = path.suffix.lower()
    if suffix in RIG_SUFFIXES and not path.is_dir():
        rig = read_rig(path)
        chosen = choose_clip(rig, clip, path)
        name = motion_name(path) if len(rig.clips) == 1 else f"{motion_name(path)}_{chosen.name}"
        found = retarget_rig(rig, chosen, skeleton, path=path, name=name, up=up, rest=rest, mapping=mapping)
        return found.motion, found
    if not path.exists():
        raise UserError(f"no pose file at {path}; give the path of one")
    if suffix not in POSE_SUFFIXES and not path.is_dir():
        wanted = f"a file ending in {', '.join(MOTION_SUFFIXES)}, or a folder of pose files"
        raise UserError(f"pose file {path}: wanted {wanted}; convert it")
    sets = read_pose_sets(path)
    if clip is not None and len(sets) == 1:
        raise UserError(f"clip: wanted {_RIGS}, got pose file {path} with one motion; leave it out")
    arrays = choose_set(sets, clip, path)
    name = motion_name(path)
    if len(sets) > 1:
        name = f"{name}_{re.sub(r'[^0-9A-Za-z.-]+', '_', arrays.label)}"
    if not arrays.has_poses:
        found = retarget_mhr(arrays, skeleton, path, name=name, up=up, rest=rest, mapping=mapping)
        return found.motion, found
    for setting, is_given in (("mapping", mapping is not None), ("rest", rest != "auto")):
        if is_given:
            raise UserError(f"{setting}: wanted {_RIGS}, got pose file {path}; leave it out")
    return motion_from_arrays(arrays, skeleton, path, name=name, up=up, hands=hands), None


def motion_name(path: Path) -> str:
    """Return the name of the motion in a file or folder; if all files of its kind are called poses or motion, the folder's."""
    if path.is_dir():
        return path.name
    return (path.absolute().parent.name or path.stem) if path.stem in _SAME_NAMES else path.stem


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
