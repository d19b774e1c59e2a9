"""The fourteen exercises of DFaust, each made by a small procedure, in anatomical angles (see `anatomy`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from snarfcli.motions.curves import Style, hop, pulse
from snarfcli.motions.footing import FootPath

__all__ = ["EXERCISES", "Scene"]

Array = NDArray[np.float64]
_TURN = 2 * np.pi


@dataclass
class Scene:
    """What a figure does, before it becomes poses."""

    angles: dict[str, Array]
    """Degrees [T] by name."""
    pelvis: Array
    """[T, 3] metres from where the pelvis of a straight stand is. Without planted feet: above the floor."""
    feet: dict[str, FootPath] = field(default_factory=dict)
    """Paths of planted feet, by side; the other legs follow the angles. With none the lowest point touches the floor."""


def _stand(style: Style, t: Array) -> Scene:
    """Someone standing at ease: arms hanging, a little sway, never quite still and never quite symmetric."""
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
    sway = np.stack([style.noise(t, 0.008), style.noise(t, 0.0015) - style.between(0.005, 0.012), style.noise(t, 0.008)], 1)
    return Scene(angles, sway, feet)


def _hopping(scene: Scene, lift: Array, extension: Array, sides: str = "lr", point_deg: float = 30.0) -> None:
    """Move pelvis and feet up and down with a hop on the balls of the feet, which point at the floor in flight."""
    scene.pelvis[:, 1] += lift + 0.0017 * point_deg  # a lifted heel lengthens the leg
    for side in sides:
        foot = scene.feet[side]
        foot.y = foot.y + np.maximum(lift, 0)
        foot.heel = foot.heel + point_deg * (0.2 + 0.8 * extension)


def _add(scene: Scene, **angles: Array | float) -> None:
    for name, value in angles.items():
        scene.angles[name] = scene.angles.get(name, 0.0) + value


def _chicken_wings(style: Style, t: Array) -> Scene:
    scene = _stand(style, t)
    phase = style.phase(t, style.around(1.1))
    low, high = style.around(38), style.around(88, 0.1)
    lag = style.between(-0.04, 0.04)
    for side, delay in (("l", 0.0), ("r", lag)):
        flap = 0.5 - 0.5 * np.cos(_TURN * (phase + delay))
        scene.angles |= {
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
    scene.pelvis[:, 1] -= style.around(0.035, 0.6) * bob
    _add(scene, spine_flex=style.around(5) * bob, head_nod=-3 * bob)
    return scene


def _hips(style: Style, t: Array) -> Scene:
    scene = _stand(style, t)
    phase = _TURN * style.phase(t, style.around(0.55)) * style.rng.choice([-1, 1])
    size = style.around(0.085, 0.2)
    scene.pelvis[:, 0] += size * np.cos(phase)
    scene.pelvis[:, 2] += 0.85 * size * np.sin(phase)
    scene.pelvis[:, 1] -= 0.035 + 0.01 * np.cos(2 * phase)
    tilt, side_tilt = style.around(15), style.around(12)
    _add(scene, pelvis_tilt=-tilt * np.sin(phase), spine_flex=1.1 * tilt * np.sin(phase))
    _add(scene, pelvis_list=-side_tilt * np.cos(phase), spine_bend=1.1 * side_tilt * np.cos(phase))
    _add(scene, pelvis_turn=5 * np.sin(phase + 0.6), spine_twist=-5 * np.sin(phase + 0.6))
    for side, sign in (("l", 1), ("r", -1)):  # hands on the hips
        scene.feet[side].x = scene.feet[side].x + sign * 0.04
        scene.angles |= {
            f"{side}_arm_abd": style.around(46, 0.08) + style.noise(t, 2),
            f"{side}_arm_flex": -style.around(14, 0.3) + style.noise(t, 2),
            f"{side}_arm_roll": -style.around(44, 0.1) + style.noise(t, 2),
            f"{side}_elbow": style.around(88, 0.06) + style.noise(t, 2),
            f"{side}_pron": style.around(30) + style.noise(t, 2),
            f"{side}_wrist_flex": -style.around(25, 0.3) + style.noise(t, 2),
        }
    return scene


def _jiggle_on_toes(style: Style, t: Array) -> Scene:
    scene = _stand(style, t)
    phase = style.phase(t, style.around(3.2, 0.12))
    wave = np.sin(_TURN * phase)
    scene.pelvis[:, 1] += 0.012 * wave + 0.05
    for side in "lr":
        scene.feet[side].heel = scene.feet[side].heel + style.around(20, 0.2) + 8 * wave
        late = np.sin(_TURN * (phase - 0.16 - style.between(0, 0.08)))
        later = np.sin(_TURN * (phase - 0.3))
        _add(
            scene,
            **{
                f"{side}_arm_abd": style.around(7) + style.around(4) * late,
                f"{side}_arm_flex": style.around(4) * late,
                f"{side}_elbow": 8 + style.around(7) * later,
                f"{side}_pron": style.around(12) * late,
                f"{side}_wrist_flex": style.around(14) * later,
                f"{side}_shrug": 4 + 4 * late,
            },
        )
    _add(scene, spine_flex=1.5 * wave, head_nod=2.5 * np.sin(_TURN * (phase - 0.2)), spine_twist=style.noise(t, 4))
    return scene


def _jumping_jacks(style: Style, t: Array) -> Scene:
    scene = _stand(style, t)
    tempo = style.around(0.95, 0.1)
    phase = style.phase(t, tempo)
    # Two hops a cycle: legs go apart in the first flight, together in the second.
    lift, extension = hop(2 * phase, 0.5 / tempo, style.around(0.045, 0.25))
    opened = 0.5 - 0.5 * np.cos(_TURN * (phase - 0.09))
    _hopping(scene, lift, extension)
    width = style.around(0.26, 0.12)
    scene.pelvis[:, 1] -= 0.045 * opened
    raised = style.around(158, 0.08)
    for side, sign in (("l", 1), ("r", -1)):
        scene.feet[side].x = scene.feet[side].x + sign * width * opened
        scene.feet[side].yaw = scene.feet[side].yaw + 8 * opened
        delay = style.between(-0.02, 0.02)
        up = 0.5 - 0.5 * np.cos(_TURN * (phase - 0.07 + delay))
        scene.angles |= {
            f"{side}_arm_abd": 15 + (raised - 15) * up + style.noise(t, 2),
            f"{side}_arm_flex": 8 + style.around(14, 0.5) * np.sin(np.pi * up) + style.noise(t, 2),
            f"{side}_arm_roll": style.around(24, 0.4) * up,
            f"{side}_elbow": style.around(14, 0.5) + style.around(22, 0.4) * up + style.noise(t, 2),
            f"{side}_pron": 10 + 10 * up + style.noise(t, 3),
        }
    _add(scene, head_nod=-6 * opened, spine_flex=-4 * opened)
    return scene


def _knees(style: Style, t: Array) -> Scene:
    scene = _stand(style, t)
    phase = style.phase(t, style.around(0.62, 0.12))
    height = style.around(88, 0.12)
    for side, other, delay in (("l", "r", 0.0), ("r", "l", 0.5)):
        raised = pulse(phase, delay + 0.25, 0.5)
        foot = scene.feet[side]
        # the knee rises in front, its shank hanging: the foot's way is that of the ball below a bent leg
        foot.y = foot.y + style.around(0.46, 0.1) * raised * height / 88
        foot.z = foot.z + (0.20 + style.between(-0.04, 0.04)) * raised
        foot.heel = foot.heel + style.around(28, 0.4) * raised
        sign = 1 if side == "l" else -1
        scene.pelvis[:, 0] -= sign * 0.055 * raised
        _add(scene, pelvis_list=-sign * 4 * raised, pelvis_tilt=-7 * raised, spine_flex=9 * raised)
        _add(scene, spine_twist=-sign * style.around(9, 0.4) * raised)
        swing = style.around(34, 0.3)
        _add(scene, **{f"{other}_arm_flex": swing * raised, f"{other}_elbow": style.around(45, 0.4) * raised})
        _add(scene, **{f"{side}_arm_flex": -14 * raised, f"{side}_elbow": 14 * raised})
    return scene


def _light_hopping(style: Style, t: Array, loose: float) -> Scene:
    scene = _stand(style, t)
    tempo = style.around(2.15, 0.1)
    phase = style.phase(t, tempo)
    lift, extension = hop(phase, 1 / tempo, style.around(0.036, 0.25))
    _hopping(scene, lift, extension, point_deg=style.around(30, 0.2))
    wave = np.sin(_TURN * phase)
    for side in "lr":
        late = np.sin(_TURN * (phase - 0.2 - style.between(0, 0.08)))
        later = np.sin(_TURN * (phase - 0.36))
        _add(
            scene,
            **{
                f"{side}_arm_abd": loose * (8 + style.around(9) * late) - 2 * (1 - loose),
                f"{side}_arm_flex": loose * style.around(9) * late,
                f"{side}_elbow": loose * (14 + style.around(16) * later) - 6 * (1 - loose),
                f"{side}_pron": loose * style.around(14) * late,
                f"{side}_wrist_flex": loose * style.around(18) * later,
                f"{side}_shrug": 2 + (2 + 6 * loose) * late,
            },
        )
    _add(scene, spine_flex=(1 + 3 * loose) * wave, head_nod=(1.5 + 5 * loose) * np.sin(_TURN * (phase - 0.15)))
    _add(scene, spine_twist=loose * style.noise(t, 6), head_turn=loose * style.noise(t, 6))
    return scene


def _on_one_leg(style: Style, t: Array, scene: Scene) -> tuple[str, str, int]:
    """Shift the weight over one foot, for good: the pelvis above it, the trunk upright. Returns stance, free side, sign."""
    stance, free, sign = ("l", "r", 1) if style.rng.uniform() < 0.5 else ("r", "l", -1)
    foot = scene.feet[stance]
    foot.x = foot.x * 0 - sign * 0.02
    foot.z = foot.z * 0 + 0.0
    scene.pelvis[:, 0] += sign * 0.075
    _add(scene, pelvis_list=sign * style.around(3, 0.5), spine_bend=sign * style.around(2, 0.5))
    return stance, free, sign


def _one_leg_jump(style: Style, t: Array) -> Scene:
    scene = _stand(style, t)
    stance, free, _ = _on_one_leg(style, t, scene)
    tempo = style.around(1.8, 0.1)
    phase = style.phase(t, tempo)
    lift, extension = hop(phase, 1 / tempo, style.around(0.045, 0.25))
    _hopping(scene, lift, extension, stance)
    wave, late = np.sin(_TURN * phase), np.sin(_TURN * (phase - 0.2))
    foot = scene.feet[free]
    foot.y = foot.y + style.around(0.26, 0.25) + lift + 0.02 * late
    foot.z = foot.z + style.between(-0.28, -0.08) + 0.02 * late
    foot.heel = foot.heel + style.around(48, 0.25)
    abd = style.around(30, 0.3)
    for side in "lr":
        _add(
            scene,
            **{
                f"{side}_arm_abd": style.around(abd, 0.2) + 11 * late,
                f"{side}_arm_flex": style.around(14, 0.5) + 9 * late,
                f"{side}_elbow": style.around(38, 0.3) + 12 * np.sin(_TURN * (phase - 0.35)),
                f"{side}_shrug": 3 + 4 * late,
            },
        )
    _add(scene, pelvis_tilt=5 + 3 * wave, spine_flex=4 + 2 * wave, head_nod=3 * late)
    return scene


def _one_leg_loose(style: Style, t: Array) -> Scene:
    scene = _stand(style, t)
    _, free, sign = _on_one_leg(style, t, scene)
    shake = style.phase(t, style.around(2.3, 0.15))
    slow = style.noise(t, 1.0, 0.1, 0.45)
    foot = scene.feet[free]
    foot.y = foot.y + style.around(0.14, 0.3) + 0.03 * slow + 0.035 * np.sin(_TURN * shake)
    foot.z = foot.z + 0.20 + 0.09 * slow + 0.045 * np.sin(_TURN * (shake - 0.2))
    foot.x = foot.x - sign * (0.07 + 0.03 * style.noise(t, 1.0, 0.1, 0.45) + 0.025 * np.sin(_TURN * (shake + 0.1)))
    foot.heel = foot.heel + 18 + 14 * np.sin(_TURN * (shake - 0.3))
    foot.yaw = foot.yaw + 9 * np.sin(_TURN * (shake - 0.25))
    for side in "lr":
        _add(
            scene,
            **{
                f"{side}_arm_abd": style.around(26, 0.4) + style.noise(t, 6),
                f"{side}_arm_flex": style.around(8, 0.6) + style.noise(t, 5),
                f"{side}_elbow": style.around(18, 0.5) + style.noise(t, 5),
            },
        )
    return scene


def _punching(style: Style, t: Array) -> Scene:
    scene = _stand(style, t)
    phase = style.phase(t, style.around(0.95, 0.15))
    stagger, crouch = style.around(0.1, 0.3), style.around(0.06, 0.3)
    lead = style.rng.choice([-1, 1])
    scene.pelvis[:, 1] -= crouch
    total = 0.0
    for side, sign, centre in (("l", 1, 0.25), ("r", -1, 0.75)):
        out = pulse(phase, centre + style.between(-0.02, 0.02), style.around(0.44, 0.1)) ** 0.8
        scene.feet[side].z = scene.feet[side].z + lead * sign * stagger
        scene.feet[side].x = scene.feet[side].x + sign * 0.05
        level, across = style.around(84, 0.1), style.around(10, 0.6)
        scene.angles |= {
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
    _add(scene, spine_twist=twist * total, pelvis_turn=0.4 * twist * total, head_turn=-1.1 * twist * total)
    _add(scene, spine_flex=8.0, pelvis_tilt=4.0)
    scene.pelvis[:, 2] += 0.02 * np.abs(total)
    return scene


def _running_on_spot(style: Style, t: Array) -> Scene:
    scene = _stand(style, t)
    tempo = style.around(1.35, 0.1)
    phase = style.phase(t, tempo)
    # Each foot is down around its own half cycle; in between both are in the air.
    lift, _ = hop(2 * phase - 0.17, 0.5 / tempo, style.around(0.03, 0.3))
    scene.pelvis[:, 1] += lift + 0.03
    knee_high, heel_back = style.around(0.34, 0.2), style.around(0.16, 0.3)
    pump = style.around(34, 0.2)
    for side, sign, delay in (("l", 1, 0.0), ("r", -1, 0.5)):
        swing = pulse(phase, delay + 0.25, 0.72)
        late = pulse(phase, delay + 0.17, 0.62)
        foot = scene.feet[side]
        foot.y = foot.y + knee_high * swing
        foot.z = foot.z + 0.12 * swing - heel_back * late
        foot.heel = foot.heel + 12 + style.around(44, 0.15) * late
        foot.yaw = foot.yaw * 0.5
        beat = np.cos(_TURN * (phase - delay - 0.25))  # this arm goes back when this knee is up
        scene.angles |= {
            f"{side}_arm_flex": 4 - pump * beat + style.noise(t, 2),
            f"{side}_arm_abd": style.around(24, 0.15) + style.noise(t, 2),
            f"{side}_arm_roll": -style.around(4, 0.8) + style.noise(t, 2),
            f"{side}_elbow": style.around(86, 0.1) - 14 * beat + style.noise(t, 2),
            f"{side}_curl": 55 + style.noise(t, 3),
        }
        scene.pelvis[:, 0] -= sign * 0.02 * swing
        _add(scene, pelvis_turn=sign * -4 * beat, spine_twist=sign * 9 * beat, pelvis_list=-sign * 2.5 * swing)
    _add(scene, pelvis_tilt=5.0, spine_flex=4.0, head_nod=-4.0)
    return scene


def _shake_arms(style: Style, t: Array) -> Scene:
    scene = _stand(style, t)
    shake = style.phase(t, style.around(3.0, 0.15))
    for side in "lr":
        level = style.around(62, 0.15) + style.noise(t, 14, 0.1, 0.4)
        front = style.between(5, 45) + style.noise(t, 12, 0.1, 0.4)
        delay = style.between(-0.1, 0.1)
        wave = np.sin(_TURN * (shake + delay))
        late = np.sin(_TURN * (shake + delay - 0.15))
        later = np.sin(_TURN * (shake + delay - 0.3))
        scene.angles |= {
            f"{side}_arm_abd": level + style.around(9) * wave,
            f"{side}_arm_flex": front + style.around(6) * late,
            f"{side}_arm_roll": style.noise(t, 12) + style.around(12) * late,
            f"{side}_elbow": style.around(30, 0.3) + style.around(15) * late + style.noise(t, 4),
            f"{side}_pron": 10 + style.around(24) * later,
            f"{side}_wrist_flex": style.around(30) * later,
            f"{side}_curl": 18 + 10 * later,
            f"{side}_shrug": 4 + 4 * wave,
        }
    scene.pelvis[:, 1] += 0.006 * np.sin(_TURN * shake)
    _add(scene, spine_bend=style.noise(t, 3), spine_twist=style.noise(t, 4) + 2 * np.sin(_TURN * shake))
    return scene


def _shake_hips(style: Style, t: Array) -> Scene:
    scene = _stand(style, t)
    phase = _TURN * style.phase(t, style.around(1.5, 0.15))
    swing, turn = style.around(0.045, 0.25), style.around(8, 0.4)
    scene.pelvis[:, 0] += swing * np.sin(phase)
    scene.pelvis[:, 1] -= 0.04
    tilt = style.around(11, 0.2)
    _add(scene, pelvis_list=-tilt * np.sin(phase), spine_bend=1.15 * tilt * np.sin(phase))
    _add(scene, pelvis_turn=turn * np.cos(phase), spine_twist=-1.1 * turn * np.cos(phase))
    level = style.between(20, 62)
    for side, sign in (("l", 1), ("r", -1)):
        scene.feet[side].x = scene.feet[side].x + sign * 0.03
        _add(
            scene,
            **{
                f"{side}_arm_abd": 0.5 * level + sign * 5 * np.sin(phase - 0.6) + style.noise(t, 5),
                f"{side}_arm_flex": 0.3 * level + sign * 6 * np.cos(phase - 0.6) + style.noise(t, 4),
                f"{side}_elbow": level + 8 * np.sin(phase - 0.9) + style.noise(t, 4),
            },
        )
    return scene


def _shake_shoulders(style: Style, t: Array) -> Scene:
    scene = _stand(style, t)
    phase = _TURN * style.phase(t, style.around(2.1, 0.15))
    level = style.between(10, 50)
    for side, sign in (("l", 1), ("r", -1)):
        wave, late = sign * np.sin(phase), sign * np.sin(phase - 0.8)
        _add(
            scene,
            **{
                f"{side}_shrug": 8 + 7 * sign * np.cos(phase),
                f"{side}_protract": style.around(18, 0.15) * wave,
                f"{side}_arm_flex": 0.4 * level + 10 * late + style.noise(t, 3),
                f"{side}_arm_abd": 8 + 0.3 * level + style.noise(t, 4),
                f"{side}_elbow": level + 8 * late + style.noise(t, 4),
            },
        )
    size = style.around(10, 0.3)
    _add(scene, spine_twist=-size * np.sin(phase), head_turn=0.9 * size * np.sin(phase), spine_bend=style.noise(t, 3))
    _add(scene, pelvis_turn=3 * np.sin(phase), spine_flex=style.around(8, 0.6) + style.noise(t, 4))
    return scene


EXERCISES: dict[str, Callable[[Style, Array], Scene]] = {
    "chicken_wings": _chicken_wings,
    "hips": _hips,
    "jiggle_on_toes": _jiggle_on_toes,
    "jumping_jacks": _jumping_jacks,
    "knees": _knees,
    "light_hopping_loose": lambda style, t: _light_hopping(style, t, 1.0),
    "light_hopping_stiff": lambda style, t: _light_hopping(style, t, 0.1),
    "one_leg_jump": _one_leg_jump,
    "one_leg_loose": _one_leg_loose,
    "punching": _punching,
    "running_on_spot": _running_on_spot,
    "shake_arms": _shake_arms,
    "shake_hips": _shake_hips,
    "shake_shoulders": _shake_shoulders,
}
"""Procedures by name of the DFaust sequence."""
