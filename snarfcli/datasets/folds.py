"""Pose-dependent folds of cloth at fixed places of the body.

A joint that rotates by R changes the direction d of its bone, given in the canonical pose, by m = R d - d. Cloth whose normal n
points in the direction of this motion (n . m > 0) is compressed and gets folds across the bone; on the other side it is tight.
Twisting the trunk causes folds that slant to the left or to the right. All folds depend smoothly on the pose, and each reaches
only cloth near its joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Folds", "place_folds"]

_BENT = (  # joint, the joint at the other end of its bone, and how far from the joint there are folds, metres
    ("l_hip", "l_knee", 0.26),
    ("r_hip", "r_knee", 0.26),
    ("spine1", "spine3", 0.28),
    ("spine2", "spine3", 0.28),
    ("spine3", "neck", 0.28),
    ("l_shoulder", "l_elbow", 0.26),
    ("r_shoulder", "r_elbow", 0.26),
    ("l_knee", "l_ankle", 0.20),
    ("r_knee", "r_ankle", 0.20),
    ("l_elbow", "l_wrist", 0.18),
    ("r_elbow", "r_wrist", 0.18),
)
_TWISTED = ("spine1", "spine2", "spine3")
_TWIST_REACH_M = 0.36
_WAVE_LENGTH_M = (0.055, 0.08)  # from one fold to the next, at least and at most
_TRUNK_RADIUS_M = 0.14  # converts angles around the trunk to lengths
_STEEPNESS = 4.0  # bending a joint by 12 degrees already gives folds about three quarters of their maximum depth
_TWIST_STEEPNESS = 4.0  # the same for twists
_ROUNDING = 0.05  # width of the smooth transition between compressed and tight, in units of n . m
_TIGHT = 0.6  # inward displacement of tight cloth, as a share of the depth of folds
_SHARE_OF_STAND_OFF = 0.6  # depth as a share of the distance of the cloth from the body; below 1, so that they never touch
_MAX_DEPTH_M = 0.018


@dataclass(frozen=True, eq=False)
class Folds:
    """The folds of one garment: at D places that each depend on how one joint bends, and at E places that depend on a twist."""

    depth_m: NDArray[np.float64]
    """[V], maximum displacement of the cloth inwards or outwards, metres; 0 for skin."""
    bent: NDArray[np.int64]
    """[D], indices of the joints whose bending causes the folds."""
    directions: NDArray[np.float64]
    """[D, 3], unit directions of the bones of these joints in the canonical pose."""
    facing: NDArray[np.float64]
    """[V, 3], unit vectors that point away from the body, canonical pose; 0 for skin."""
    reached: NDArray[np.float64]
    """[D, V], influence of each place on a vertex, 0 to 1."""
    waves: NDArray[np.float64]
    """[D, V], shape of the folds, -1 to 1."""
    twisted: NDArray[np.int64]
    """[E], indices of the joints whose twist causes the folds."""
    twist_reached: NDArray[np.float64]
    """[E, V], influence of each twist on a vertex, 0 to 1."""
    slanting: NDArray[np.float64]
    """[2, V], shape of folds that slant to the left and to the right, -1 to 1."""

    def displacement(self, turned: NDArray) -> NDArray[np.float64]:
        """Return the displacement [B, V] of the cloth along `facing`, metres, from -`depth_m` to `depth_m`.

        Args:
            turned: [B, J, 3, 3], rotation of each joint from the canonical pose, in the axes of its parent.
        """
        moved = np.einsum("bdij,dj->bdi", turned[:, self.bent], self.directions) - self.directions
        total = np.zeros((len(turned), len(self.depth_m)))
        for place, (reached, waves) in enumerate(zip(self.reached, self.waves, strict=True)):
            facing = moved[:, place] @ self.facing.T
            rounded = np.sqrt(facing**2 + _ROUNDING**2) - _ROUNDING
            pushed, drawn = (rounded + facing) / 2, (rounded - facing) / 2
            total += reached * (np.tanh(_STEEPNESS * pushed) * waves - _TIGHT * np.tanh(_STEEPNESS * drawn))
        rotations = turned[:, self.twisted]
        twist = (rotations[..., 0, 2] - rotations[..., 2, 0]) / 2  # sine of the angle about y, along the spine
        rounded = np.sqrt(twist**2 + _ROUNDING**2) - _ROUNDING
        for share, slanting in zip(((rounded + twist) / 2, (rounded - twist) / 2), self.slanting, strict=True):
            total += np.tanh(_TWIST_STEEPNESS * share) @ self.twist_reached * slanting
        return self.depth_m * np.tanh(total)


def place_folds(vertices: NDArray, facing: NDArray, stand_off_m: NDArray, joints: dict[str, NDArray], seed: int) -> Folds:
    """Return the folds of a garment.

    Args:
        vertices: [V, 3], cloth and skin in the canonical pose, metres.
        facing: [V, 3], unit vectors that point away from the body; 0 for skin.
        stand_off_m: [V], distance from the body, metres; 0 for skin.
        joints: positions [3] by SMPL's joint names, canonical pose, metres; their order is that of the joint indices.
        seed: seed of the random lengths and places of the folds.
    """
    random = np.random.default_rng([seed, 3])  # 3: the stream of random numbers for folds
    names = list(joints)
    directions, reached, waves = [], [], []
    for name, end, reach in _BENT:
        start = joints[name]
        along = (joints[end] - start) / np.linalg.norm(joints[end] - start)
        offset = vertices - start
        along_m = offset @ along
        # Folds are not flat rings: around the limb, each fold goes up and down once or twice.
        side, front = np.cross(along, [0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])
        round_rad = np.arctan2(offset @ front, offset @ side)
        shift = random.uniform(0, 2 * np.pi, 3)
        bow = 0.9 * np.sin(round_rad + shift[0]) + 0.6 * np.sin(2 * round_rad + shift[1])
        directions.append(along)
        reached.append(_reached(offset, reach))
        waves.append(np.sin(2 * np.pi * along_m / random.uniform(*_WAVE_LENGTH_M) + bow + shift[2]))
    middle = joints["spine2"]
    round_m = _TRUNK_RADIUS_M * np.arctan2(vertices[:, 0] - middle[0], vertices[:, 2] - middle[2])
    height = vertices[:, 1] - middle[1]
    shift, length = random.uniform(0, 2 * np.pi, 2), random.uniform(*_WAVE_LENGTH_M)
    # Seen from outside, turning the chest to the left causes folds that rise towards the left, and vice versa.
    slanting = [np.sin(2 * np.pi * (height - sign * round_m) * np.sqrt(0.5) / length + shift[0]) for sign in (1, -1)]
    # The angle around the trunk jumps by a full turn in the middle of the back, so the folds fade out there.
    fading = np.cos(np.clip(round_m / _TRUNK_RADIUS_M, -np.pi, np.pi) / 2) ** 2
    return Folds(
        depth_m=np.minimum(_SHARE_OF_STAND_OFF * stand_off_m, _MAX_DEPTH_M),
        bent=np.array([names.index(name) for name, _, _ in _BENT]),
        directions=np.array(directions),
        facing=facing,
        reached=np.array(reached),
        waves=np.array(waves),
        twisted=np.array([names.index(name) for name in _TWISTED]),
        twist_reached=np.array([_reached(vertices - joints[name], _TWIST_REACH_M) for name in _TWISTED]),
        slanting=fading * np.array(slanting),
    )


def _reached(offset: NDArray, reach: float) -> NDArray[np.float64]:
    """Return the influence [V] of a joint: 1 at the joint, decreasing smoothly to 0 at the distance `reach`.

    Args:
        offset: [V, 3], offsets from the joint, metres.
        reach: distance from the joint, metres.
    """
    return np.maximum(1 - (offset * offset).sum(1) / reach**2, 0) ** 2
