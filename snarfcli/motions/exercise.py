"""An exercise as joint angles and root track, before conversion to poses, and the stand that exercises start from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from snarfcli.motions.curves import Style
from snarfcli.motions.footing import FootPath

__all__ = ["Exercise", "add", "stand"]

Array = NDArray[np.float64]


@dataclass
class Exercise:
    """Joint angles and tracks of pelvis and feet over time."""

    angles: dict[str, Array]
    """[T] per name of `anatomy.LIMITS_DEG`, degrees."""
    pelvis: Array
    """[T, 3], offset of the pelvis from standing straight, metres; added to the height on the floor if no foot is planted."""
    feet: dict[str, FootPath] = field(default_factory=dict)
    """Paths of planted feet by side, `l` or `r`; other legs follow the angles. If empty, the lowest point touches the floor."""


def stand(style: Style, t: Array) -> Exercise:
    """Return a relaxed stand with hanging arms, a slight sway, small motions and slight asymmetry."""
    zero = np.zeros_like(t)
    angles = {
        "pelvis_tilt": style.between(0, 4) + style.noise(t, 1.0),
        "pelvis_list": style.noise(t, 1.0),
        "pelvis_turn": style.noise(t, 2.0),
        "spine_flex": style.between(-4, 8) + style.noise(t, 3.0),
        "spine_bend": style.noise(t, 2.5),
        "spine_twist": style.noise(t, 4.0),
        "head_nod": style.between(-4, 12) + style.noise(t, 6.0),
        "head_tilt": style.noise(t, 4.0),
        "head_turn": style.noise(t, 12.0, 0.1, 0.6),
    }
    abd, elbow = style.between(13, 19), style.between(10, 22)
    for side in "lr":
        angles |= {
            f"{side}_arm_flex": style.between(-2, 8) + style.noise(t, 2.0),
            f"{side}_arm_abd": abd + style.between(-2, 2) + style.noise(t, 1.5),
            f"{side}_arm_roll": style.between(-12, 6) + style.noise(t, 2.0),
            f"{side}_elbow": elbow + style.noise(t, 2.5),
            f"{side}_pron": style.between(5, 25) + style.noise(t, 4.0),
            f"{side}_wrist_flex": style.between(-5, 12) + style.noise(t, 4.0),
            f"{side}_wrist_dev": style.noise(t, 3.0),
            f"{side}_curl": style.between(10, 30) + style.noise(t, 4.0),
        }
    width, yaw = style.between(-0.01, 0.07), style.between(4, 16)
    feet = {
        side: FootPath(zero + sign * width, zero.copy(), zero + style.between(-0.03, 0.03), zero + yaw, zero.copy())
        for side, sign in (("l", 1), ("r", -1))
    }
    sway = np.stack([style.noise(t, 0.008), style.noise(t, 0.0015) - style.between(0.010, 0.017), style.noise(t, 0.008)], 1)
    return Exercise(angles, sway, feet)


def add(exercise: Exercise, **angles: Array | float) -> None:
    """Add degrees, constant or [T], to angles of the exercise."""
    for name, value in angles.items():
        exercise.angles[name] = np.add(exercise.angles.get(name, 0.0), value)
