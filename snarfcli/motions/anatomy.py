"""Convert anatomical angles to SMPL poses, with joint limits, for a figure of an average adult.

Built-in motions are written in anatomical angles, in degrees, one array [T] per name of `LIMITS_DEG`; missing angles are zero.
All zero is standing straight with hanging arms and palms inwards.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = ["JOINTS_REST", "LIMITS_DEG", "PARENTS", "Angles", "joint_positions", "poses_from_angles"]

Array = NDArray[np.float64]
Angles = Mapping[str, Array]

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
"""SMPL's joint tree."""

# An average adult in a T-pose, y up, facing +z, left is +x, metres. Used only for the floor and planted feet of motions.
JOINTS_REST = np.array(
    [
        (0, -0.220, 0.030), (0.110, -0.312, 0.060), (-0.110, -0.312, 0.060), (0, -0.150, 0.044),
        (0.142, -0.682, 0.091), (-0.142, -0.682, 0.091), (0, -0.070, 0.043), (0.182, -1.099, 0.062),
        (-0.182, -1.099, 0.062), (0, 0.055, 0.033), (0.193, -1.148, 0.201), (-0.193, -1.148, 0.201),
        (0, 0.236, 0.066), (0.061, 0.177, 0.082), (-0.061, 0.177, 0.082), (0, 0.306, 0.084),
        (0.171, 0.164, 0.078), (-0.171, 0.164, 0.078), (0.426, 0.164, 0.078), (-0.426, 0.164, 0.078),
        (0.653, 0.164, 0.078), (-0.653, 0.164, 0.078), (0.753, 0.164, 0.078), (-0.753, 0.164, 0.078),
    ]
)  # fmt: skip


# Ranges of motion in degrees: passive ranges of flexible adults, since the extremes come close to them; everyday motion stays
# far inside (tables of the American Academy of Orthopaedic Surgeons: hip flexion 120, knee 135, shoulder 180, elbow 150).
_UNPAIRED = {
    "pelvis_tilt": (-180, 180), "pelvis_list": (-180, 180), "pelvis_turn": (-180, 180),
    "spine_flex": (-60, 80), "spine_bend": (-40, 40), "spine_twist": (-50, 50),
    "head_nod": (-65, 55), "head_tilt": (-40, 40), "head_turn": (-75, 75),
}  # fmt: skip
_PAIRED = {
    "hip_flex": (-40, 130), "hip_abd": (-25, 85), "hip_rot": (-45, 95), "knee": (0, 145),
    "ankle": (-50, 35), "toe": (-30, 60),
    "shrug": (-10, 30), "protract": (-25, 25), "arm_flex": (-60, 180), "arm_abd": (-45, 180), "arm_roll": (-90, 90),
    "elbow": (0, 150), "pron": (-85, 85), "wrist_flex": (-70, 75), "wrist_dev": (-20, 35), "curl": (-15, 80),
}  # fmt: skip
LIMITS_DEG: dict[str, tuple[float, float]] = {
    **_UNPAIRED,
    **{f"{side}_{name}": limits for side in "lr" for name, limits in _PAIRED.items()},
}
"""Minimum and maximum of every angle, degrees.

Signs. pelvis and spine: tilt/flex forwards, list/bend to the left, turn/twist to the left; head likewise. hip: flexion
(knee up), abduction (out), external rotation. knee: flexion. ankle: toes up. toe: up. shrug: up. protract: forwards. arm:
`flex` and `abd` are the two components of the swing from hanging (forwards, sideways); roll: external. elbow: flexion.
pron: pronation. wrist: towards the palm, towards the thumb. curl: fingers towards the palm.
"""

# Elbow and wrist share the twist of the forearm; otherwise the skin of the wrist would collapse.
_PRONATION_AT_ELBOW = 0.45
_SPINE_SHARES = {3: 0.3, 6: 0.35, 9: 0.35}
_MIRROR = np.diag([-1.0, 1.0, 1.0])


def _axis(axis: str, degrees: Array) -> Rotation:
    return Rotation.from_euler(axis, degrees[:, None], degrees=True)


def _swing(flex: Array, abd: Array) -> Rotation:
    """Return the swing of a hanging left limb by `flex` degrees forwards and `abd` degrees outwards (+x)."""
    return Rotation.from_rotvec(np.stack([-flex, np.zeros_like(flex), abd], -1), degrees=True)


def _left_arm(get: Callable[[str], Array]) -> dict[int, Rotation]:
    """Return the rotations of collar, shoulder, elbow, wrist and hand of the left arm, each relative to its parent.

    Args:
        get: returns the angle of a name without side, [T], degrees.
    """
    flex, abd = get("arm_flex"), get("arm_abd")
    elevation = np.hypot(flex, abd)
    # The shoulder blade follows the raised arm (scapulohumeral rhythm, about one degree in three beyond 30).
    lift = -7 + 30 * (1 / (1 + np.exp(-(elevation - 105) / 28))) + get("shrug")
    forward = get("protract") + 12 * np.sin(np.radians(np.clip(flex, -90, 90)))
    collar = _swing(np.zeros_like(lift), lift) * _axis("y", -forward)
    hanging = _axis("z", np.full_like(flex, -90.0))
    arm = _swing(flex, abd) * _axis("y", get("arm_roll")) * hanging
    pron = get("pron")
    return {
        13: collar,
        16: collar.inv() * arm,
        18: _axis("y", -get("elbow")) * _axis("x", _PRONATION_AT_ELBOW * pron),
        20: _axis("x", (1 - _PRONATION_AT_ELBOW) * pron) * _axis("y", -get("wrist_dev")) * _axis("z", -get("wrist_flex")),
        22: _axis("z", -get("curl")),
    }


def _left_leg(get: Callable[[str], Array]) -> dict[int, Rotation]:
    """Return the rotations of hip, knee, ankle and foot of the left leg, each relative to its parent; `get` as above."""
    # In the rest pose the legs are apart, about 9 degrees per side; zero abduction is a vertical leg.
    return {
        1: _swing(get("hip_flex"), get("hip_abd") - 9) * _axis("y", get("hip_rot")),
        4: _axis("x", get("knee")),
        7: _axis("x", -get("ankle")) * _axis("z", 9 + 0 * get("ankle")),
        10: _axis("x", -get("toe")),
    }


def poses_from_angles(angles: Angles, frames: int) -> Array:
    """Convert anatomical angles to poses.

    Args:
        angles: [T] per name of `LIMITS_DEG`, degrees; values outside the limits are clipped.
        frames: number T of frames.

    Returns:
        [T, 24, 3], axis-angle, radians.

    Raises:
        ValueError: the name of an angle is unknown.
    """
    unknown = sorted(set(angles) - set(LIMITS_DEG))
    if unknown:
        raise ValueError(f"angles: wanted names of {', '.join(LIMITS_DEG)}; got {', '.join(unknown)}")

    def get(name: str) -> Array:
        return np.clip(np.broadcast_to(angles.get(name, 0.0), frames), *LIMITS_DEG[name]).astype(np.float64)

    local: dict[int, Rotation] = {
        0: _axis("y", get("pelvis_turn")) * _axis("x", get("pelvis_tilt")) * _axis("z", -get("pelvis_list"))
    }
    for joint, share in _SPINE_SHARES.items():
        local[joint] = Rotation.from_rotvec(
            share * np.stack([get("spine_flex"), get("spine_twist"), -get("spine_bend")], -1), degrees=True
        )
    for joint in (12, 15):
        local[joint] = Rotation.from_rotvec(
            0.5 * np.stack([get("head_nod"), get("head_turn"), -get("head_tilt")], -1), degrees=True
        )
    for side in "lr":

        def of_side(name: str, side: str = side) -> Array:
            return get(f"{side}_{name}")

        for joint, rotation in {**_left_leg(of_side), **_left_arm(of_side)}.items():
            if side == "l":
                local[joint] = rotation
            else:  # in SMPL's order each right joint follows its left one
                local[joint + 1] = Rotation.from_matrix(_MIRROR @ rotation.as_matrix() @ _MIRROR)
    return np.stack([local[joint].as_rotvec() for joint in range(24)], 1)


def joint_positions(poses: Array, translation: Array | None = None) -> tuple[Array, Array]:
    """Pose the average adult.

    Args:
        poses: [T, 24, 3], axis-angle, radians.
        translation: [T, 3], metres; none by default.

    Returns:
        positions: [T, 24, 3], joints, metres.
        rotations: [T, 24, 3, 3], global rotations of the joints.
    """
    local = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(len(poses), 24, 3, 3)
    rotations, positions = np.empty_like(local), np.empty_like(poses)
    for joint, parent in enumerate(PARENTS):
        if parent < 0:
            rotations[:, joint] = local[:, joint]
            positions[:, joint] = JOINTS_REST[0] + (0 if translation is None else translation)
        else:
            rotations[:, joint] = rotations[:, parent] @ local[:, joint]
            offset = JOINTS_REST[joint] - JOINTS_REST[parent]
            positions[:, joint] = positions[:, parent] + rotations[:, parent] @ offset
    return positions, rotations
