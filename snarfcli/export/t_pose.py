"""The T-pose of a human skeleton, as VRM 1.0 defines it: standing straight, facing +z, arms and hands level along x.

Source: VRM Consortium, VRMC_vrm 1.0, "VRM T-pose".
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.bodies import Skeleton
from snarfcli.export.rig import Stance

__all__ = ["t_pose_stance"]

Array = NDArray[np.float64]

_SEGMENTS = ("Metacarpal", "Proximal", "Intermediate", "Distal")
_SNAP_RAD = np.radians(20)  # a body at rest within this angle of an axis counts as standing along it


def t_pose_stance(skeleton: Skeleton, bones: Mapping[str, int]) -> Stance:
    """Return the T-pose of a human skeleton, with the axes of all joints parallel to those of the world.

    The whole body is turned upright and to +z. Then each bone of arms, hands, fingers and legs gets the smallest rotation to
    its direction; feet point to +z at their slope. Trunk and head keep their rest pose. The hips are above the origin.

    Args:
        skeleton: its rest pose may be any standing pose.
        bones: joints by the names of VRM's humanoid bones; the required ones are there.
    """
    rest = skeleton.joints_rest.detach().cpu().double().numpy()
    turns = _turns(rest, skeleton.parents, bones)
    places = np.zeros_like(rest)
    for joint, parent in enumerate(skeleton.parents):
        places[joint] = (
            turns[parent] @ (rest[joint] - rest[parent]) + places[parent] if parent >= 0 else turns[joint] @ rest[joint]
        )
    places -= places[bones["hips"]] * (1, 0, 1)
    from_rest = np.tile(np.eye(4), (len(rest), 1, 1))
    from_rest[:, :3, :3] = turns
    from_rest[:, :3, 3] = places - np.einsum("jab,jb->ja", turns, rest)
    frames = np.tile(np.eye(4), (len(rest), 1, 1))
    frames[:, :3, 3] = places
    precise = skeleton.to(dtype=torch.float64, device="cpu")
    canonical_from_rest = precise.posed_from_rest(precise.canonical_pose[None])[0].numpy()
    return Stance(from_rest @ np.linalg.inv(canonical_from_rest), frames)


def _turns(rest: Array, parents: Sequence[int], bones: Mapping[str, int]) -> list[Array]:
    """Return the world rotation [3, 3] of each joint from its rest pose to the T-pose."""
    whole = _whole_turn(rest, bones)
    aims = {bones[bone]: (bones[end], aim) for bone, end, aim in _aims(bones)}
    feet = {bones["leftFoot"], bones["rightFoot"]}
    turns: list[Array] = []
    for joint, parent in enumerate(parents):
        # Feet are upright independently of the leg, as in `rest_turns`.
        turn = whole if parent < 0 or joint in feet else turns[parent]
        if joint in aims:
            end, aim = aims[joint]
            bone = turn @ (rest[end] - rest[joint])
            if joint in feet:
                aim = np.array([0, bone[1], np.hypot(bone[0], bone[2])])
            turn = _smallest_turn(bone, aim) @ turn
        turns.append(turn)
    return turns


def _aims(bones: Mapping[str, int]) -> list[tuple[str, str, Array]]:
    """Return the bones that are turned: bone, the bone that it points to, and the direction [3]."""
    found = []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        out, thumb, down = np.array([sign, 0, 0]), np.array([sign, 0, 1]), np.array([0, -1.0, 0])
        chains = [(("UpperArm", "LowerArm", "Hand", "MiddleProximal"), out), (("UpperLeg", "LowerLeg", "Foot"), down)]
        chains += [(("Foot", "Toes"), np.array([0, 0, 1.0]))]
        for finger, aim in (("Thumb", thumb), ("Index", out), ("Middle", out), ("Ring", out), ("Little", out)):
            chains.append((tuple(finger + segment for segment in _SEGMENTS), aim))
        for chain, aim in chains:
            there = [side + name for name in chain if side + name in bones]
            found += [(bone, end, aim) for bone, end in itertools.pairwise(there)]
    return found


def _whole_turn(rest: Array, bones: Mapping[str, int]) -> Array:
    """Return the rotation [3, 3] that turns the body at rest upright, with its left to +x."""
    left = np.zeros(3)
    for bone in ("UpperLeg", "UpperArm"):
        across = rest[bones[f"left{bone}"]] - rest[bones[f"right{bone}"]]
        left += across / max(float(np.linalg.norm(across)), 1e-12)
    hips = (rest[bones["leftUpperLeg"]] + rest[bones["rightUpperLeg"]]) / 2
    up = _snapped(rest[bones["head"]] - hips)
    left = _snapped(left - (left @ up) * up)
    left = left - (left @ up) * up
    left /= max(float(np.linalg.norm(left)), 1e-12)
    return np.stack([left, up, np.cross(left, up)])


def _snapped(direction: Array) -> Array:
    """Return a unit vector, that of the nearest axis if it is near."""
    unit = direction / max(float(np.linalg.norm(direction)), 1e-12)
    axis = np.zeros(3)
    axis[np.argmax(np.abs(unit))] = np.sign(unit[np.argmax(np.abs(unit))])
    return axis if unit @ axis > np.cos(_SNAP_RAD) else unit


def _smallest_turn(before: Array, after: Array) -> Array:
    """Return the matrix [3, 3] of the smallest rotation from one direction to another; the identity if one has no length."""
    lengths = np.linalg.norm(before), np.linalg.norm(after)
    if min(lengths) < 1e-9:
        return np.eye(3)
    return Rotation.align_vectors((after / lengths[1])[None], (before / lengths[0])[None])[0].as_matrix()
