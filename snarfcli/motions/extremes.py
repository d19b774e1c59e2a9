"""Smooth sequences of poses near the limits of the joints, in anatomical angles (see `anatomy`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from snarfcli.motions.anatomy import LIMITS_DEG
from snarfcli.motions.curves import Style, through
from snarfcli.motions.exercise import Exercise

__all__ = ["EXTREMES", "perform"]

Array = NDArray[np.float64]
Pose = Mapping[str, float]


def _both(**angles: float) -> dict[str, float]:
    """Return the same angles for both sides."""
    return {f"{side}_{name}": value for name, value in angles.items() for side in "lr"}


_EASE = _both(hip_abd=6, arm_abd=16, elbow=16, curl=18, pron=10)

# Every pose is written for one side; `_mirrored` gives the other. Angles that are not named are those of `_EASE`.
POSES: dict[str, Pose] = {
    "stand": {},
    "side_split": {**_both(hip_abd=78, hip_rot=35, ankle=-35, arm_abd=95, elbow=8), "spine_flex": 6, "pelvis_tilt": 20},
    "front_split": {
        "l_hip_flex": 128, "r_hip_flex": -40, "l_ankle": -30, "r_ankle": -42, "l_knee": 4, "r_knee": 4, "pelvis_tilt": 42,
        "spine_flex": -34, **_both(arm_abd=88, elbow=8),
    },
    "deep_squat": {
        **_both(hip_flex=112, knee=126, hip_abd=28, hip_rot=26, ankle=33, arm_flex=86, arm_abd=8, elbow=22),
        "pelvis_tilt": 20, "spine_flex": 26, "head_nod": -28,
    },
    "squat_arms_up": {
        **_both(hip_flex=102, knee=116, hip_abd=24, hip_rot=20, ankle=33, arm_flex=150, arm_abd=25, elbow=12),
        "pelvis_tilt": 26, "spine_flex": 2, "head_nod": -15,
    },
    "bridge": {
        **_both(hip_flex=-34, knee=86, hip_abd=16, ankle=-2, arm_flex=172, arm_abd=16, elbow=18, wrist_flex=-68),
        "pelvis_tilt": -84, "spine_flex": -56, "head_nod": -50,
    },
    "arms_back": {**_both(arm_flex=-56, arm_abd=26, elbow=6, protract=-18, wrist_flex=30), "spine_flex": -8},
    "hands_behind_back": {
        **_both(arm_flex=-58, arm_abd=20, arm_roll=-50, elbow=74, pron=40, shrug=6, protract=-18),
        "spine_flex": -12, "head_nod": -10,
    },
    "elbows_back": {**_both(arm_flex=-50, arm_abd=34, arm_roll=-10, elbow=120, protract=-22), "spine_flex": -20},
    "high_kick": {
        "l_hip_flex": 112, "l_knee": 12, "l_ankle": -30, "r_hip_flex": -8, "r_knee": 8, "pelvis_tilt": -18, "spine_flex": 14,
        "l_arm_abd": 55, "l_arm_flex": -20, "r_arm_abd": 60, "r_arm_flex": 40, "r_elbow": 40,
    },
    "guard": {
        "l_hip_flex": 34, "r_hip_flex": 12, "r_knee": 40, "l_knee": 36, "r_ankle": 22, "pelvis_turn": -24,
        **_both(arm_flex=42, arm_abd=12, elbow=118, curl=65, hip_abd=16, hip_rot=14), "spine_flex": 12, "head_turn": 22,
    },
    "side_kick": {
        "l_hip_abd": 76, "l_hip_rot": 12, "l_knee": 10, "pelvis_list": -32, "spine_bend": -24, "r_hip_abd": -8, "r_knee": 12,
        "r_hip_flex": 6, "head_tilt": 22, **_both(arm_flex=55, elbow=112, arm_abd=18, curl=65),
    },
    "lunge": {
        "l_hip_flex": 98, "l_knee": 96, "l_ankle": 8, "r_hip_flex": -30, "r_knee": 44, "r_ankle": 26, "r_toe": 50,
        **_both(arm_abd=150, arm_flex=30, elbow=15), "spine_flex": -12,
    },
    "lunge_twist": {
        "l_hip_flex": 108, "l_knee": 100, "l_ankle": 10, "r_hip_flex": -24, "r_knee": 30, "r_ankle": 20, "r_toe": 50,
        "pelvis_tilt": 14, "spine_twist": 46, "spine_flex": 18, "head_turn": 40, **_both(arm_abd=92, elbow=6),
    },
    "side_lunge": {
        "l_hip_flex": 92, "l_hip_abd": 45, "l_hip_rot": 38, "l_knee": 112, "l_ankle": 30, "r_hip_abd": 46, "r_hip_flex": 20,
        "r_hip_rot": 10, "pelvis_tilt": 24, "spine_flex": 24, **_both(arm_flex=70, arm_abd=10, elbow=60), "head_nod": -20,
    },
    "sit": {
        **_both(hip_flex=92, knee=88, hip_abd=14, arm_flex=26, arm_abd=18, elbow=55), "pelvis_tilt": 2, "spine_flex": 8,
    },
    "long_sit_reach": {
        **_both(hip_flex=93, knee=3, ankle=14, arm_flex=108, arm_abd=10, elbow=8, hip_abd=14), "pelvis_tilt": 6,
        "spine_flex": 46, "head_nod": 10,
    },
    "cross_legged": {
        **_both(hip_flex=88, hip_abd=72, hip_rot=94, knee=118, arm_flex=30, arm_abd=24, elbow=48, ankle=-25),
        "l_knee": 130, "spine_flex": 14, "pelvis_tilt": -6,
    },
    "tuck": {
        **_both(hip_flex=112, knee=126, hip_abd=14, hip_rot=8, ankle=20, arm_flex=78, arm_abd=22, elbow=72, arm_roll=-40),
        "pelvis_tilt": -4, "spine_flex": 42, "head_nod": 36,
    },
    "forward_fold": {
        **_both(hip_flex=78, knee=8, ankle=6, hip_abd=10, arm_flex=128, arm_abd=6, elbow=6), "pelvis_tilt": 76,
        "spine_flex": 66, "head_nod": 25,
    },
    "back_bend": {
        **_both(hip_flex=-22, knee=30, ankle=33, arm_flex=140, arm_abd=40, elbow=20), "pelvis_tilt": -18, "spine_flex": -54,
        "head_nod": -52,
    },
    "side_bend": {
        "spine_bend": 38, "pelvis_list": 8, "l_hip_abd": 18, "r_hip_abd": 26, "r_arm_abd": 168, "r_elbow": 20, "l_arm_abd": 36,
        "l_elbow": 10, "head_tilt": 24,
    },
    "twist": {
        "spine_twist": 48, "pelvis_turn": 18, "head_turn": 62, "l_arm_abd": 78, "l_arm_flex": -45, "r_arm_flex": 88,
        "r_arm_abd": -30, "r_elbow": 35, **_both(hip_abd=14),
    },
    "hug": {
        **_both(arm_flex=74, arm_abd=-22, elbow=96, arm_roll=-68, protract=20, pron=30), "r_arm_flex": 60,
        "spine_flex": 20, "head_nod": 14,
    },
    "arms_wide": {
        **_both(arm_abd=104, arm_flex=-24, elbow=4, protract=-20, wrist_flex=-40), "spine_flex": -16, "head_nod": -12,
    },
    "arms_overhead": {**_both(arm_flex=172, arm_abd=10, elbow=6, shrug=12), "spine_flex": -8, "head_nod": -16},
    "hands_behind_head": {
        **_both(arm_abd=134, arm_flex=8, arm_roll=64, elbow=122, wrist_flex=20), "spine_flex": -10, "head_nod": 6,
    },
    "arabesque": {
        "l_hip_flex": -36, "l_hip_rot": 30, "l_knee": 14, "l_ankle": -44, "r_hip_flex": 58, "r_knee": 8, "pelvis_tilt": 62,
        "spine_flex": -38, "head_nod": -40, "r_arm_flex": 118, "r_arm_abd": 16, "l_arm_abd": 82, "l_arm_flex": -22,
    },
    "quad_stretch": {
        "l_hip_flex": -14, "l_knee": 126, "l_ankle": -30, "l_arm_flex": -38, "l_arm_abd": 16, "l_elbow": 30, "r_arm_abd": 110,
        "r_knee": 8,
    },
    "knee_to_chest": {
        "l_hip_flex": 112, "l_knee": 122, "l_ankle": -10, "r_knee": 6, "spine_flex": 18,
        **_both(arm_flex=62, arm_abd=6, elbow=70, arm_roll=-30),
    },
    "kneel": {**_both(hip_flex=4, knee=92, ankle=-48, hip_abd=12, arm_abd=20)},
    "kneel_back": {
        **_both(hip_flex=-22, knee=92, ankle=-46, hip_abd=14, arm_flex=-54, arm_abd=26, arm_roll=30), "spine_flex": -50,
        "pelvis_tilt": -22, "head_nod": -45,
    },
    "all_fours": {
        **_both(hip_flex=92, knee=92, ankle=-46, arm_flex=86, arm_abd=6, wrist_flex=-66), "pelvis_tilt": 84, "head_nod": -30,
    },
    "push_up": {
        **_both(hip_flex=4, ankle=20, toe=55, arm_flex=76, arm_abd=10, wrist_flex=-66, elbow=6), "pelvis_tilt": 74,
        "head_nod": -25,
    },
}  # fmt: skip

EXTREMES: dict[str, tuple[str, ...]] = {
    "splits": ("front_split", "side_lunge", "side_split", "-side_lunge", "-front_split", "-lunge"),
    "deep_squats": ("stand", "deep_squat", "squat_arms_up", "tuck", "sit", "side_lunge", "-side_lunge"),
    "bridges": ("push_up", "all_fours", "kneel_back", "kneel", "lunge", "back_bend", "bridge"),
    "arms_behind_back": (
        "arms_back", "hands_behind_back", "arms_wide", "hug", "elbows_back", "arms_overhead", "hands_behind_head",
    ),
    "high_kicks": (
        "guard", "high_kick", "-guard", "-high_kick", "guard", "side_kick", "-guard", "-side_kick", "quad_stretch",
    ),
    "lunges": ("lunge", "lunge_twist", "arabesque", "knee_to_chest", "-lunge_twist", "-lunge"),
    "sits_and_twists": ("stand", "twist", "-side_bend", "forward_fold", "sit", "cross_legged", "long_sit_reach"),
}  # fmt: skip
"""Key poses of each sequence; a minus sign means the mirrored pose."""


def _mirrored(pose: Pose) -> dict[str, float]:
    other = {"l": "r", "r": "l"}
    turned = {"pelvis_list", "pelvis_turn", "spine_bend", "spine_twist", "head_tilt", "head_turn"}
    return {
        (other[name[0]] + name[1:] if name[:2] in ("l_", "r_") else name): -value if name in turned else value
        for name, value in pose.items()
    }


def _key_pose(name: str) -> Pose:
    pose = _mirrored(POSES[name[1:]]) if name.startswith("-") else POSES[name]
    return {**_EASE, **pose}


def perform(keys: Sequence[str], style: Style, t: Array, duration_s: float) -> Exercise:
    """Move smoothly from key pose to key pose, holding each, with extent and timing varied by `style`."""
    poses = [_key_pose(name) for name in keys]
    parts = np.array([style.around(1.0, 0.2) for _ in keys])
    parts[-1] *= 0.5  # the last pose has no transition after it
    ends = np.cumsum(parts) / parts.sum() * duration_s
    times = np.stack([np.concatenate([[0], ends[:-1]]), ends - 0.72 * parts / parts.sum() * duration_s], 1).ravel()
    times = np.append(times, duration_s)
    angles: dict[str, Array] = {}
    for name, (low, high) in LIMITS_DEG.items():
        values = [pose.get(name, 0.0) * style.around(1.0, 0.06) for pose in poses]
        curve = through(t, times, [*np.repeat(values, 2), values[-1]])
        angles[name] = np.clip(curve + style.noise(t, 1.2), low, high)
    return Exercise(angles, np.zeros((len(t), 3)))
