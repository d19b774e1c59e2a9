"""Poses near the limits of the joints, joined into smooth sequences, in anatomical angles (see `anatomy`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from snarfcli.motions.anatomy import LIMITS_DEG
from snarfcli.motions.curves import Style, through
from snarfcli.motions.everyday import Scene

__all__ = ["EXTREMES", "perform"]

Array = NDArray[np.float64]
Pose = Mapping[str, float]


def _both(**angles: float) -> dict[str, float]:
    """Give both sides the same angles."""
    return {f"{side}_{name}": value for name, value in angles.items() for side in "lr"}


_REST = _both(arm_abd=16, elbow=16, curl=18, pron=10)

# Every pose is written for one side; `_mirrored` makes the other.
POSES: dict[str, Pose] = {
    "stand": _REST,
    "side_split": {**_both(hip_abd=78, hip_rot=35, ankle=-35, arm_abd=95, elbow=8), "spine_flex": 6, "pelvis_tilt": 20},
    "front_split": {
        "l_hip_flex": 88, "r_hip_flex": -38, "l_ankle": -30, "r_ankle": -42, "r_knee": 10, "pelvis_tilt": 12,
        "spine_flex": -14, **_both(arm_abd=88, elbow=8),
    },
    "deep_squat": {
        **_both(hip_flex=118, knee=132, hip_abd=28, hip_rot=22, ankle=33, arm_flex=78, arm_abd=8, elbow=22),
        "pelvis_tilt": 22, "spine_flex": 30, "head_nod": -28,
    },
    "squat_arms_up": {
        **_both(hip_flex=105, knee=118, hip_abd=24, hip_rot=18, ankle=33, arm_flex=150, arm_abd=25, elbow=12),
        "pelvis_tilt": 26, "spine_flex": 2, "head_nod": -15,
    },
    "bridge": {
        **_both(hip_flex=-34, knee=86, hip_abd=16, ankle=-2, arm_flex=172, arm_abd=16, elbow=18, wrist_flex=-68),
        "pelvis_tilt": -108, "spine_flex": -56, "head_nod": -50,
    },
    "hands_behind_back": {
        **_both(arm_flex=-46, arm_abd=12, arm_roll=-62, elbow=88, pron=40, shrug=6, protract=-18),
        "spine_flex": -12, "head_nod": -10,
    },
    "elbows_back": {**_both(arm_flex=-50, arm_abd=34, arm_roll=-10, elbow=125, protract=-22), "spine_flex": -20},
    "high_kick": {
        "l_hip_flex": 112, "l_knee": 12, "l_ankle": -30, "r_hip_flex": -8, "r_knee": 8, "pelvis_tilt": -18, "spine_flex": 14,
        "l_arm_abd": 55, "l_arm_flex": -20, "r_arm_abd": 60, "r_arm_flex": 40, "r_elbow": 40,
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
        "l_hip_flex": 92, "l_hip_abd": 45, "l_hip_rot": 30, "l_knee": 112, "l_ankle": 30, "r_hip_abd": 46, "r_hip_flex": 20,
        "r_hip_rot": 10, "pelvis_tilt": 24, "spine_flex": 24, **_both(arm_flex=70, arm_abd=10, elbow=60), "head_nod": -20,
    },
    "sit": {
        **_both(hip_flex=92, knee=88, hip_abd=14, arm_flex=26, arm_abd=18, elbow=55), "pelvis_tilt": 2, "spine_flex": 8,
    },
    "long_sit_reach": {
        **_both(hip_flex=95, knee=6, ankle=14, arm_flex=108, arm_abd=8, elbow=10, hip_abd=10), "pelvis_tilt": 12,
        "spine_flex": 62, "head_nod": 20,
    },
    "cross_legged": {
        **_both(hip_flex=96, hip_abd=58, hip_rot=48, knee=128, arm_flex=30, arm_abd=30, elbow=60, pron=-40),
        "spine_flex": 10, "pelvis_tilt": -4,
    },
    "tuck": {
        **_both(hip_flex=122, knee=136, hip_abd=12, arm_flex=66, arm_abd=12, elbow=75, arm_roll=-20), "pelvis_tilt": -16,
        "spine_flex": 62, "head_nod": 45,
    },
    "forward_fold": {
        **_both(hip_flex=78, knee=8, ankle=6, hip_abd=10, arm_flex=128, arm_abd=6, elbow=6), "pelvis_tilt": 76,
        "spine_flex": 66, "head_nod": 25,
    },
    "back_bend": {
        **_both(hip_flex=-22, knee=34, ankle=10, arm_flex=140, arm_abd=40, elbow=20), "pelvis_tilt": -18, "spine_flex": -54,
        "head_nod": -52,
    },
    "side_bend": {
        "spine_bend": 38, "pelvis_list": 8, "l_hip_abd": 18, "r_hip_abd": 26, "r_arm_abd": 168, "r_elbow": 20, "l_arm_abd": 8,
        "l_elbow": 10, "head_tilt": 24,
    },
    "twist": {
        "spine_twist": 48, "pelvis_turn": 18, "head_turn": 62, "l_arm_abd": 78, "l_arm_flex": -45, "r_arm_flex": 88,
        "r_arm_abd": -30, "r_elbow": 35, **_both(hip_abd=14),
    },
    "hug": {
        **_both(arm_flex=82, arm_abd=-36, elbow=92, arm_roll=-10, protract=20), "spine_flex": 24, "head_nod": 18,
    },
    "arms_overhead": {**_both(arm_flex=172, arm_abd=10, elbow=6, shrug=12), "spine_flex": -8, "head_nod": -16},
    "hands_behind_head": {**_both(arm_abd=128, arm_flex=36, arm_roll=68, elbow=138), "spine_flex": -10, "head_nod": 14},
    "arabesque": {
        "l_hip_flex": -36, "l_hip_rot": 30, "l_knee": 14, "l_ankle": -44, "r_hip_flex": 58, "r_knee": 8, "pelvis_tilt": 62,
        "spine_flex": -38, "head_nod": -40, "r_arm_flex": 118, "r_arm_abd": 16, "l_arm_abd": 82, "l_arm_flex": -22,
    },
    "quad_stretch": {
        "l_hip_flex": -14, "l_knee": 132, "l_ankle": -30, "l_arm_flex": -38, "l_arm_abd": 14, "l_elbow": 30, "r_arm_abd": 110,
        "r_knee": 8,
    },
    "knee_to_chest": {
        "l_hip_flex": 120, "l_knee": 128, "l_ankle": -10, "r_knee": 8, "spine_flex": 26,
        **_both(arm_flex=52, arm_abd=-4, elbow=72, arm_roll=-25),
    },
    "kneel": {**_both(hip_flex=8, knee=96, ankle=-48, hip_abd=12, arm_abd=20), "pelvis_tilt": 0},
    "kneel_back": {
        **_both(hip_flex=-20, knee=112, ankle=-48, hip_abd=14, arm_flex=-54, arm_abd=22, arm_roll=30), "spine_flex": -52,
        "pelvis_tilt": -16, "head_nod": -45,
    },
    "all_fours": {**_both(hip_flex=92, knee=92, ankle=-46, arm_flex=86, arm_abd=6, wrist_flex=-66), "pelvis_tilt": 84,
                  "head_nod": -30},
    "push_up": {**_both(hip_flex=4, ankle=20, toe=55, arm_flex=76, arm_abd=10, wrist_flex=-66, elbow=6), "pelvis_tilt": 74,
                "head_nod": -25},
}  # fmt: skip

EXTREMES: dict[str, tuple[str, ...]] = {
    "splits": ("stand", "side_split", "deep_squat", "front_split", "-front_split", "stand"),
    "deep_squats": ("stand", "deep_squat", "squat_arms_up", "tuck", "side_lunge", "-side_lunge", "stand"),
    "bridges": ("stand", "back_bend", "bridge", "back_bend", "kneel", "kneel_back", "kneel"),
    "arms_behind_back": ("stand", "hands_behind_back", "elbows_back", "hands_behind_head", "hug", "arms_overhead", "stand"),
    "high_kicks": ("stand", "high_kick", "-side_kick", "-high_kick", "side_kick", "quad_stretch", "stand"),
    "lunges": ("stand", "lunge", "lunge_twist", "arabesque", "-knee_to_chest", "-lunge_twist", "stand"),
    "sits_and_twists": ("stand", "sit", "long_sit_reach", "cross_legged", "all_fours", "twist", "-side_bend", "forward_fold"),
}
"""Key poses of each sequence; a minus sign asks for the mirrored pose."""


def _mirrored(pose: Pose) -> dict[str, float]:
    other = {"l": "r", "r": "l"}
    turned = {"pelvis_list", "pelvis_turn", "spine_bend", "spine_twist", "head_tilt", "head_turn"}
    return {
        (other[name[0]] + name[1:] if name[:2] in ("l_", "r_") else name): -value if name in turned else value
        for name, value in pose.items()
    }


def _key_pose(name: str) -> Pose:
    return _mirrored(POSES[name[1:]]) if name.startswith("-") else POSES[name]


def perform(keys: Sequence[str], style: Style, t: Array, duration_s: float) -> Scene:
    """Move smoothly from key pose to key pose, dwelling in each, with a person's own extent and timing."""
    poses = [_key_pose(name) for name in keys]
    parts = np.array([style.around(1.0, 0.2) for _ in keys])
    ends = np.cumsum(parts) / parts.sum() * duration_s
    times = np.stack([np.concatenate([[0], ends[:-1]]), ends - 0.72 * parts / parts.sum() * duration_s], 1).ravel()
    times = np.append(times, duration_s)
    angles: dict[str, Array] = {}
    for name, (low, high) in LIMITS_DEG.items():
        values = [pose.get(name, 0.0) * style.around(1.0, 0.06) for pose in poses]
        curve = through(t, times, [*np.repeat(values, 2), values[-1]])
        angles[name] = np.clip(curve + style.noise(t, 1.2), low, high)
    return Scene(angles, np.zeros((len(t), 3)))
