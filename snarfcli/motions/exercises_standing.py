"""Exercises with both feet on the floor, in anatomical angles (see `anatomy`).

Each function imitates the DFaust sequence of its name.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from snarfcli.motions.curves import Style, pulse
from snarfcli.motions.exercise import Exercise, add, stand

__all__ = ["STANDING_EXERCISES"]

Array = NDArray[np.float64]
_TURN = 2 * np.pi


def _chicken_wings(style: Style, t: Array) -> Exercise:
    exercise = stand(style, t)
    phase = style.phase(t, style.around(1.1))
    low, high = style.around(38), style.around(88, 0.1)
    lag = style.between(-0.04, 0.04)
    for side, delay in (("l", 0.0), ("r", lag)):
        flap = 0.5 - 0.5 * np.cos(_TURN * (phase + delay))
        exercise.angles |= {
            f"{side}_arm_abd": low + (high - low) * flap + style.noise(t, 2),
            f"{side}_arm_flex": style.around(22, 0.3) + 10 * flap + style.noise(t, 2),
            f"{side}_arm_roll": -style.around(50) - 14 * flap + style.noise(t, 2),
            f"{side}_elbow": style.around(122, 0.04) + 8 * flap + style.noise(t, 1.5),
            f"{side}_pron": style.around(35) + style.noise(t, 3),
            f"{side}_wrist_flex": style.around(25, 0.4) + 12 * flap + style.noise(t, 3),
            f"{side}_curl": style.around(45, 0.3) + style.noise(t, 3),
            f"{side}_shrug": 6 * flap,
        }
    bob = 0.5 - 0.5 * np.cos(_TURN * phase)
    exercise.pelvis[:, 1] -= style.around(0.035, 0.6) * bob
    add(exercise, spine_flex=style.around(5) * bob, head_nod=-3 * bob)
    return exercise


def _hips(style: Style, t: Array) -> Exercise:
    exercise = stand(style, t)
    phase = _TURN * style.phase(t, style.around(0.55)) * style.rng.choice([-1, 1])
    size = style.around(0.085, 0.2)
    exercise.pelvis[:, 0] += size * np.cos(phase)
    exercise.pelvis[:, 2] += 0.85 * size * np.sin(phase)
    exercise.pelvis[:, 1] -= 0.035 + 0.01 * np.cos(2 * phase)
    tilt, side_tilt = style.around(15), style.around(12)
    add(exercise, pelvis_tilt=-tilt * np.sin(phase), spine_flex=1.1 * tilt * np.sin(phase))
    add(exercise, pelvis_list=-side_tilt * np.cos(phase), spine_bend=1.1 * side_tilt * np.cos(phase))
    add(exercise, pelvis_turn=5 * np.sin(phase + 0.6), spine_twist=-5 * np.sin(phase + 0.6))
    for side, sign in (("l", 1), ("r", -1)):  # hands on the hips
        exercise.feet[side].x = exercise.feet[side].x + sign * 0.04
        exercise.angles |= {
            f"{side}_arm_abd": style.around(46, 0.08) + style.noise(t, 2),
            f"{side}_arm_flex": -style.around(14, 0.3) + style.noise(t, 2),
            f"{side}_arm_roll": -style.around(40, 0.1) + style.noise(t, 2),
            f"{side}_elbow": style.around(88, 0.06) + style.noise(t, 2),
            f"{side}_pron": style.around(30) + style.noise(t, 2),
            f"{side}_wrist_flex": -style.around(25, 0.3) + style.noise(t, 2),
        }
    return exercise


def _jiggle_on_toes(style: Style, t: Array) -> Exercise:
    exercise = stand(style, t)
    phase = style.phase(t, style.around(3.2, 0.12))
    wave = np.sin(_TURN * phase)
    exercise.pelvis[:, 1] += 0.012 * wave + 0.05
    for side in "lr":
        exercise.feet[side].heel = exercise.feet[side].heel + style.around(20, 0.2) + 8 * wave
        late = np.sin(_TURN * (phase - 0.16 - style.between(0, 0.08)))
        later = np.sin(_TURN * (phase - 0.3))
        add(
            exercise,
            **{
                f"{side}_arm_abd": style.around(7) + style.around(4) * late,
                f"{side}_arm_flex": style.around(4) * late,
                f"{side}_elbow": 8 + style.around(7) * later,
                f"{side}_pron": style.around(12) * late,
                f"{side}_wrist_flex": style.around(14) * later,
                f"{side}_shrug": 4 + 4 * late,
            },
        )
    add(exercise, spine_flex=1.5 * wave, head_nod=2.5 * np.sin(_TURN * (phase - 0.2)), spine_twist=style.noise(t, 4))
    return exercise


def _punching(style: Style, t: Array) -> Exercise:
    exercise = stand(style, t)
    phase = style.phase(t, style.around(0.95, 0.15))
    stagger, crouch = style.around(0.1, 0.3), style.around(0.06, 0.3)
    lead = style.rng.choice([-1, 1])
    exercise.pelvis[:, 1] -= crouch
    total = 0.0
    for side, sign, centre in (("l", 1, 0.25), ("r", -1, 0.75)):
        out = pulse(phase, centre + style.between(-0.02, 0.02), style.around(0.44, 0.1)) ** 0.8
        exercise.feet[side].z = exercise.feet[side].z + lead * sign * stagger
        exercise.feet[side].x = exercise.feet[side].x + sign * 0.05
        level, across = style.around(84, 0.1), style.around(10, 0.6)
        exercise.angles |= {
            f"{side}_arm_flex": style.around(30, 0.2) + (level - 30) * out + style.noise(t, 2),
            f"{side}_arm_abd": style.around(14, 0.3) - (14 + across) * out + style.noise(t, 2),
            f"{side}_arm_roll": -style.around(8, 0.5) - 12 * out,
            f"{side}_elbow": style.around(122, 0.06) - style.around(106, 0.05) * out + style.noise(t, 2),
            f"{side}_pron": -10 + 62 * out + style.noise(t, 3),
            f"{side}_wrist_flex": style.noise(t, 3),
            f"{side}_curl": 72 + style.noise(t, 2),
            f"{side}_protract": 14 * out,
        }
        total = total - sign * out
    twist = style.around(21, 0.2)
    add(exercise, spine_twist=twist * total, pelvis_turn=0.4 * twist * total, head_turn=-1.1 * twist * total)
    add(exercise, spine_flex=8.0, pelvis_tilt=4.0)
    exercise.pelvis[:, 2] += 0.02 * np.abs(total)
    return exercise


def _shake_arms(style: Style, t: Array) -> Exercise:
    exercise = stand(style, t)
    shake = style.phase(t, style.around(3.0, 0.15))
    for side in "lr":
        level = style.around(62, 0.15) + style.noise(t, 14, 0.1, 0.4)
        front = style.between(5, 45) + style.noise(t, 12, 0.1, 0.4)
        delay = style.between(-0.1, 0.1)
        wave = np.sin(_TURN * (shake + delay))
        late = np.sin(_TURN * (shake + delay - 0.15))
        later = np.sin(_TURN * (shake + delay - 0.3))
        exercise.angles |= {
            f"{side}_arm_abd": level + style.around(9) * wave,
            f"{side}_arm_flex": front + style.around(6) * late,
            f"{side}_arm_roll": style.noise(t, 12) + style.around(12) * late,
            f"{side}_elbow": style.around(30, 0.3) + style.around(15) * late + style.noise(t, 4),
            f"{side}_pron": 10 + style.around(24) * later,
            f"{side}_wrist_flex": style.around(30) * later,
            f"{side}_curl": 18 + 10 * later,
            f"{side}_shrug": 4 + 4 * wave,
        }
    exercise.pelvis[:, 1] += 0.006 * np.sin(_TURN * shake)
    add(exercise, spine_bend=style.noise(t, 3), spine_twist=style.noise(t, 4) + 2 * np.sin(_TURN * shake))
    return exercise


def _shake_hips(style: Style, t: Array) -> Exercise:
    exercise = stand(style, t)
    phase = _TURN * style.phase(t, style.around(1.5, 0.15))
    swing, turn = style.around(0.045, 0.25), style.around(8, 0.4)
    exercise.pelvis[:, 0] += swing * np.sin(phase)
    exercise.pelvis[:, 1] -= 0.04
    tilt = style.around(11, 0.2)
    add(exercise, pelvis_list=-tilt * np.sin(phase), spine_bend=1.15 * tilt * np.sin(phase))
    add(exercise, pelvis_turn=turn * np.cos(phase), spine_twist=-1.1 * turn * np.cos(phase))
    level = style.between(20, 62)
    for side, sign in (("l", 1), ("r", -1)):
        exercise.feet[side].x = exercise.feet[side].x + sign * 0.03
        add(
            exercise,
            **{
                f"{side}_arm_abd": 0.5 * level + sign * 5 * np.sin(phase - 0.6) + style.noise(t, 5),
                f"{side}_arm_flex": 0.3 * level + sign * 6 * np.cos(phase - 0.6) + style.noise(t, 4),
                f"{side}_elbow": level + 8 * np.sin(phase - 0.9) + style.noise(t, 4),
            },
        )
    return exercise


def _shake_shoulders(style: Style, t: Array) -> Exercise:
    exercise = stand(style, t)
    phase = _TURN * style.phase(t, style.around(2.1, 0.15))
    level = style.between(10, 50)
    for side, sign in (("l", 1), ("r", -1)):
        wave, late = sign * np.sin(phase), sign * np.sin(phase - 0.8)
        add(
            exercise,
            **{
                f"{side}_shrug": 8 + 7 * sign * np.cos(phase),
                f"{side}_protract": style.around(18, 0.15) * wave,
                f"{side}_arm_flex": 0.4 * level + 10 * late + style.noise(t, 3),
                f"{side}_arm_abd": 8 + 0.3 * level + style.noise(t, 4),
                f"{side}_elbow": level + 8 * late + style.noise(t, 4),
            },
        )
    size = style.around(10, 0.3)
    add(exercise, spine_twist=-size * np.sin(phase), head_turn=0.9 * size * np.sin(phase), spine_bend=style.noise(t, 3))
    add(exercise, pelvis_turn=3 * np.sin(phase), spine_flex=style.around(8, 0.6) + style.noise(t, 4))
    return exercise


STANDING_EXERCISES: dict[str, Callable[[Style, Array], Exercise]] = {
    "chicken_wings": _chicken_wings,
    "hips": _hips,
    "jiggle_on_toes": _jiggle_on_toes,
    "punching": _punching,
    "shake_arms": _shake_arms,
    "shake_hips": _shake_hips,
    "shake_shoulders": _shake_shoulders,
}
"""Functions by name of the DFaust sequence."""
