"""Exercises with hops, steps or standing on one leg, in anatomical angles (see `anatomy`).

Each function imitates the DFaust sequence of its name.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from snarfcli.motions.curves import Style, hop, pulse
from snarfcli.motions.exercise import Exercise, add, stand

__all__ = ["STEPPING_EXERCISES"]

Array = NDArray[np.float64]
_TURN = 2 * np.pi


def _hopping(exercise: Exercise, lift: Array, extension: Array, sides: str = "lr", point_deg: float = 30.0) -> None:
    """Move pelvis and feet with a hop on the balls of the feet; in flight the toes point at the floor."""
    exercise.pelvis[:, 1] += lift + 0.0017 * point_deg  # a lifted heel lengthens the leg
    for side in sides:
        foot = exercise.feet[side]
        foot.y = foot.y + np.maximum(lift, 0)
        foot.heel = foot.heel + point_deg * (0.2 + 0.8 * extension)


def _jumping_jacks(style: Style, t: Array) -> Exercise:
    exercise = stand(style, t)
    tempo = style.around(0.95, 0.1)
    phase = style.phase(t, tempo)
    # Two hops per cycle: legs go apart in the first flight, together in the second.
    lift, extension = hop(2 * phase, 0.5 / tempo, style.around(0.045, 0.25))
    opened = 0.5 - 0.5 * np.cos(_TURN * (phase - 0.09))
    _hopping(exercise, lift, extension)
    width = style.around(0.26, 0.12)
    exercise.pelvis[:, 1] -= 0.045 * opened
    raised = style.around(158, 0.08)
    for side, sign in (("l", 1), ("r", -1)):
        exercise.feet[side].x = exercise.feet[side].x + sign * width * opened
        exercise.feet[side].yaw = exercise.feet[side].yaw + 8 * opened
        delay = style.between(-0.02, 0.02)
        up = 0.5 - 0.5 * np.cos(_TURN * (phase - 0.07 + delay))
        exercise.angles |= {
            f"{side}_arm_abd": 15 + (raised - 15) * up + style.noise(t, 2),
            f"{side}_arm_flex": 8 + style.around(14, 0.5) * np.sin(np.pi * up) + style.noise(t, 2),
            f"{side}_arm_roll": style.around(24, 0.4) * up,
            f"{side}_elbow": style.around(14, 0.5) + style.around(22, 0.4) * up + style.noise(t, 2),
            f"{side}_pron": 10 + 10 * up + style.noise(t, 3),
        }
    add(exercise, head_nod=-6 * opened, spine_flex=-4 * opened)
    return exercise


def _knees(style: Style, t: Array) -> Exercise:
    exercise = stand(style, t)
    phase = style.phase(t, style.around(0.62, 0.12))
    height = style.around(88, 0.12)
    for side, other, delay in (("l", "r", 0.0), ("r", "l", 0.5)):
        raised = pulse(phase, delay + 0.25, 0.5)
        foot = exercise.feet[side]
        # the knee rises in front with a hanging shank: the path of the foot is that of the ball below a bent leg
        foot.y = foot.y + style.around(0.46, 0.1) * raised * height / 88
        foot.z = foot.z + (0.20 + style.between(-0.04, 0.04)) * raised
        foot.heel = foot.heel + style.around(28, 0.4) * raised
        sign = 1 if side == "l" else -1
        exercise.pelvis[:, 0] -= sign * 0.055 * raised
        add(exercise, pelvis_list=-sign * 4 * raised, pelvis_tilt=-7 * raised, spine_flex=9 * raised)
        add(exercise, spine_twist=-sign * style.around(9, 0.4) * raised)
        swing = style.around(34, 0.3)
        add(exercise, **{f"{other}_arm_flex": swing * raised, f"{other}_elbow": style.around(45, 0.4) * raised})
        add(exercise, **{f"{side}_arm_flex": -14 * raised, f"{side}_elbow": 14 * raised})
    return exercise


def _light_hopping(style: Style, t: Array, loose: float) -> Exercise:
    exercise = stand(style, t)
    tempo = style.around(2.15, 0.1)
    phase = style.phase(t, tempo)
    lift, extension = hop(phase, 1 / tempo, style.around(0.036, 0.25))
    _hopping(exercise, lift, extension, point_deg=style.around(30, 0.2))
    wave = np.sin(_TURN * phase)
    for side in "lr":
        late = np.sin(_TURN * (phase - 0.2 - style.between(0, 0.08)))
        later = np.sin(_TURN * (phase - 0.36))
        add(
            exercise,
            **{
                f"{side}_arm_abd": loose * (8 + style.around(9) * late) - 2 * (1 - loose),
                f"{side}_arm_flex": loose * style.around(9) * late,
                f"{side}_elbow": loose * (14 + style.around(16) * later) - 6 * (1 - loose),
                f"{side}_pron": loose * style.around(14) * late,
                f"{side}_wrist_flex": loose * style.around(18) * later,
                f"{side}_shrug": 2 + (2 + 6 * loose) * late,
            },
        )
    add(exercise, spine_flex=(1 + 3 * loose) * wave, head_nod=(1.5 + 5 * loose) * np.sin(_TURN * (phase - 0.15)))
    add(exercise, spine_twist=loose * style.noise(t, 6), head_turn=loose * style.noise(t, 6))
    return exercise


def _on_one_leg(style: Style, t: Array, exercise: Exercise) -> tuple[str, str, int]:
    """Shift the weight over one foot, trunk upright; return the stance side, the free side and the sign of x."""
    stance, free, sign = ("l", "r", 1) if style.rng.uniform() < 0.5 else ("r", "l", -1)
    foot = exercise.feet[stance]
    foot.x = foot.x * 0 - sign * 0.02
    foot.z = foot.z * 0 + 0.0
    exercise.pelvis[:, 0] += sign * 0.075
    add(exercise, pelvis_list=sign * style.around(3, 0.5), spine_bend=sign * style.around(2, 0.5))
    return stance, free, sign


def _one_leg_jump(style: Style, t: Array) -> Exercise:
    exercise = stand(style, t)
    stance, free, _ = _on_one_leg(style, t, exercise)
    tempo = style.around(1.8, 0.1)
    phase = style.phase(t, tempo)
    lift, extension = hop(phase, 1 / tempo, style.around(0.045, 0.25))
    _hopping(exercise, lift, extension, stance)
    wave, late = np.sin(_TURN * phase), np.sin(_TURN * (phase - 0.2))
    foot = exercise.feet[free]
    foot.y = foot.y + style.around(0.26, 0.25) + lift + 0.02 * late
    foot.z = foot.z + style.between(-0.28, -0.08) + 0.02 * late
    foot.heel = foot.heel + style.around(48, 0.25)
    abd = style.around(30, 0.3)
    for side in "lr":
        add(
            exercise,
            **{
                f"{side}_arm_abd": style.around(abd, 0.2) + 11 * late,
                f"{side}_arm_flex": style.around(14, 0.5) + 9 * late,
                f"{side}_elbow": style.around(38, 0.3) + 12 * np.sin(_TURN * (phase - 0.35)),
                f"{side}_shrug": 3 + 4 * late,
            },
        )
    add(exercise, pelvis_tilt=5 + 3 * wave, spine_flex=4 + 2 * wave, head_nod=3 * late)
    return exercise


def _one_leg_loose(style: Style, t: Array) -> Exercise:
    exercise = stand(style, t)
    _, free, sign = _on_one_leg(style, t, exercise)
    shake = style.phase(t, style.around(2.3, 0.15))
    slow = style.noise(t, 1.0, 0.1, 0.45)
    foot = exercise.feet[free]
    foot.y = foot.y + style.around(0.14, 0.3) + 0.03 * slow + 0.035 * np.sin(_TURN * shake)
    foot.z = foot.z + 0.20 + 0.09 * slow + 0.045 * np.sin(_TURN * (shake - 0.2))
    foot.x = foot.x - sign * (0.07 + 0.03 * style.noise(t, 1.0, 0.1, 0.45) + 0.025 * np.sin(_TURN * (shake + 0.1)))
    foot.heel = foot.heel + 18 + 14 * np.sin(_TURN * (shake - 0.3))
    foot.yaw = foot.yaw + 9 * np.sin(_TURN * (shake - 0.25))
    for side in "lr":
        add(
            exercise,
            **{
                f"{side}_arm_abd": style.around(26, 0.4) + style.noise(t, 6),
                f"{side}_arm_flex": style.around(8, 0.6) + style.noise(t, 5),
                f"{side}_elbow": style.around(18, 0.5) + style.noise(t, 5),
            },
        )
    return exercise


def _running_on_spot(style: Style, t: Array) -> Exercise:
    exercise = stand(style, t)
    tempo = style.around(1.35, 0.1)
    phase = style.phase(t, tempo)
    # Each foot is down around its own half cycle; in between both are in the air.
    lift, _ = hop(2 * phase - 0.17, 0.5 / tempo, style.around(0.03, 0.3))
    exercise.pelvis[:, 1] += lift + 0.03
    knee_high, heel_back = style.around(0.34, 0.2), style.around(0.16, 0.3)
    pump = style.around(34, 0.2)
    for side, sign, delay in (("l", 1, 0.0), ("r", -1, 0.5)):
        swing = pulse(phase, delay + 0.25, 0.72)
        late = pulse(phase, delay + 0.17, 0.62)
        foot = exercise.feet[side]
        foot.y = foot.y + knee_high * swing
        foot.z = foot.z + 0.12 * swing - heel_back * late
        foot.heel = foot.heel + 12 + style.around(44, 0.15) * late
        foot.yaw = foot.yaw * 0.5
        beat = np.cos(_TURN * (phase - delay - 0.25))  # the arm swings back when the knee of its side is up
        exercise.angles |= {
            f"{side}_arm_flex": 4 - pump * beat + style.noise(t, 2),
            f"{side}_arm_abd": style.around(24, 0.15) + style.noise(t, 2),
            f"{side}_arm_roll": -style.around(4, 0.8) + style.noise(t, 2),
            f"{side}_elbow": style.around(86, 0.1) - 14 * beat + style.noise(t, 2),
            f"{side}_curl": 55 + style.noise(t, 3),
        }
        exercise.pelvis[:, 0] -= sign * 0.02 * swing
        add(exercise, pelvis_turn=sign * -4 * beat, spine_twist=sign * 9 * beat, pelvis_list=-sign * 2.5 * swing)
    add(exercise, pelvis_tilt=5.0, spine_flex=4.0, head_nod=-4.0)
    return exercise


STEPPING_EXERCISES: dict[str, Callable[[Style, Array], Exercise]] = {
    "jumping_jacks": _jumping_jacks,
    "knees": _knees,
    "light_hopping_loose": lambda style, t: _light_hopping(style, t, 1.0),
    "light_hopping_stiff": lambda style, t: _light_hopping(style, t, 0.1),
    "one_leg_jump": _one_leg_jump,
    "one_leg_loose": _one_leg_loose,
    "running_on_spot": _running_on_spot,
}
"""Functions by name of the DFaust sequence."""
