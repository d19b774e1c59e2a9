"""The names of arrays in pose files: what a name says about its array."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Literal

__all__ = ["CONTAINER_KEYS", "FRAME_RATES", "Frame", "frame_of", "is_of_camera", "listed_keys", "role_of"]

Frame = Literal["", "world", "camera"]
"""Frame that a name mentions; empty if it mentions none."""

# Names by role, the preferred first. AMASS, CAPE, AIST++; MoSh++ and MOYO; ROMP; TRAM and PromptHMR.
_POSES = ("poses", "pose", "smpl_poses", "fullpose", "full_pose", "smpl_thetas", "pose_aa", "rotmat")
_TRANSLATIONS = ("trans", "transl", "translation", "smpl_trans", "cam_trans", "cam_t")
FRAME_RATES = ("mocap_framerate", "mocap_frame_rate", "frame_rate", "fps")
_ROLES = {
    "poses": _POSES,
    "trans": _TRANSLATIONS,
    "frame_rate": FRAME_RATES,
    "scaling": ("smpl_scaling",),
    "up": ("up",),
    # of `snarf fit`: poses of a skeleton that rests in the axes and the unit of its own files
    "rest_up": ("rest_up",),
    "metres_per_unit": ("metres_per_unit",),
    "root": ("root_orient", "global_orient", "poses_root"),
    "body": ("pose_body", "body_pose", "poses_body"),
    "hands": ("pose_hand", "hand_pose"),
    "left_hand": ("left_hand_pose", "lhand_pose"),
    "right_hand": ("right_hand_pose", "rhand_pose"),
    "jaw": ("pose_jaw", "jaw_pose"),
    "eyes": ("pose_eye",),
    "left_eye": ("leye_pose", "left_eye_pose"),
    "right_eye": ("reye_pose", "right_eye_pose"),
    # EasyMocap and ZJU-MoCap: rotation and translation about the origin of the body, beside `poses`
    "placed_rotation": ("rh",),
    "placed_translation": ("th",),
    "mhr_rotations": ("global_rots",),
    "mhr_positions": ("joint_coords",),
}
_KEYS = {key: (role, rank) for role, keys in _ROLES.items() for rank, key in enumerate(keys)}
_PREFIXES = ("pred_", "smpl_", "smplx_", "smplh_")
_FRAMES: dict[str, Frame] = {
    "world": "world", "global": "world", "w": "world",
    "incam": "camera", "camera": "camera", "cam": "camera", "c": "camera",
}  # fmt: skip
_CAMERA = re.compile(r"(pred_|pd_)?(cam|camera|cams)(_.*)?|focal.*|.*intrin.*|k_fullimg")
CONTAINER_KEYS = frozenset(
    ("results", "sequence_results", "smpl", "smplx", "smpl_params", "smplx_params", "params", "data", "outputs", "arr_0")
)
"""Names of arrays of an `.npz` file that may hold dictionaries with poses."""
_MAX_LETTERS = 200
_CHANGED = 100  # rank of a name with a prefix or an ending: after all without


def role_of(key: object) -> tuple[str, Frame, int] | None:
    """Return the role of an array, the frame that its name mentions, and the rank of the name among those of the role.

    Args:
        key: name of the array. A prefix such as `pred_` or `smpl_` and an ending such as `_world` do not change the role.

    Returns:
        For example ("poses", "world", 101) for `pose_world`; None if the array is not read.
    """
    if not isinstance(key, str) or len(key) > 60:
        return None
    name = key.lower()
    if name in _KEYS:
        role, rank = _KEYS[name]
        return role, "", rank
    plain = _without_prefixes(name)
    if plain in _KEYS:
        role, rank = _KEYS[plain]
        return role, "", rank + _CHANGED
    stem, _, end = plain.rpartition("_")
    if end in _FRAMES and stem in _KEYS:
        role, rank = _KEYS[stem]
        return role, _FRAMES[end], rank + _CHANGED
    return None


def _without_prefixes(name: str) -> str:
    for _ in range(2):
        name = next((name.removeprefix(prefix) for prefix in _PREFIXES if name.startswith(prefix)), name)
    return name


def frame_of(name: str) -> Frame:
    """Return the frame that the name of a group of arrays mentions, such as world for `smpl_params_global`."""
    words = re.split(r"[_\W]+", name.lower())
    named: list[Frame] = [_FRAMES[word] for word in words if len(word) > 1 and word in _FRAMES]
    return named[0] if named else ""


def is_of_camera(keys: Iterable[object]) -> bool:
    """Return whether names of arrays beside the poses are those of a camera, as in the results of video estimators."""
    return any(isinstance(key, str) and len(key) < 60 and _CAMERA.fullmatch(key.lower()) for key in keys)


def listed_keys(keys: Iterable[object]) -> str:
    """Return names for a message, printable and at most about 200 letters."""
    names = sorted(str(key)[:40] for key in keys)
    shown: list[str] = []
    for name in names:
        if sum(map(len, shown)) > _MAX_LETTERS:
            return ", ".join(shown) + f" and {len(names) - len(shown)} more"
        shown.append(name if name.isprintable() else ascii(name)[1:-1])
    return ", ".join(shown)
