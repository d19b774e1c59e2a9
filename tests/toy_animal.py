"""A four-legged animal made of capsules, with skinning weights and motions: about 1 m long, y up, facing +z (CC0, made here).

`toy_animal_files` writes it in the formats in which animals come.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

__all__ = ["ANIMAL_CLIPS", "HELD_OUT_CLIP", "Animal", "AnimalMotion", "animal_motion", "make_animal"]

FRAME_RATE = 30.0
ANIMAL_CLIPS = ("walk", "trot", "sniff", "sit")
HELD_OUT_CLIP = "sit"
"""A motion unlike the others, for tests of unseen poses."""

# name: parent, place at rest (metres), end of the capsule relative to it, radii at both ends (metres); left is +x.
_BODY = {
    "pelvis": ("", (0.0, 0.56, -0.26), (0.0, 0.01, 0.12), 0.105, 0.11),
    "spine": ("pelvis", (0.0, 0.57, -0.10), (0.0, 0.01, 0.16), 0.11, 0.125),
    "chest": ("spine", (0.0, 0.58, 0.10), (0.0, 0.02, 0.12), 0.13, 0.11),
    "neck": ("chest", (0.0, 0.62, 0.25), (0.0, 0.14, 0.10), 0.085, 0.065),
    "head": ("neck", (0.0, 0.78, 0.36), (0.0, -0.05, 0.17), 0.085, 0.045),
    "tail1": ("pelvis", (0.0, 0.60, -0.36), (0.0, -0.03, -0.13), 0.04, 0.032),
    "tail2": ("tail1", (0.0, 0.56, -0.51), (0.0, -0.04, -0.14), 0.032, 0.024),
}
_FRONT = {
    "upper": ((0.09, 0.52, 0.17), (0.0, -0.20, -0.02), 0.062, 0.045),
    "lower": ((0.09, 0.30, 0.15), (0.0, -0.21, 0.01), 0.042, 0.034),
    "paw": ((0.09, 0.07, 0.16), (0.0, -0.025, 0.06), 0.036, 0.034),
}
_HIND = {
    "upper": ((0.09, 0.52, -0.28), (0.0, -0.20, 0.05), 0.075, 0.05),
    "lower": ((0.09, 0.30, -0.23), (0.0, -0.21, -0.06), 0.046, 0.034),
    "paw": ((0.09, 0.07, -0.29), (0.0, -0.025, 0.06), 0.036, 0.034),
}
_SMOOTH = 0.02  # metres over which capsules are blended
_BLEND = 0.022  # metres over which weights change at a joint


@dataclass(frozen=True, eq=False)
class Animal:
    """The animal at rest."""

    names: tuple[str, ...]
    """J = 19."""
    parents: tuple[int, ...]
    """-1 for the first; a parent comes before its children."""
    joints: NDArray[np.float64]
    """[J, 3], metres."""
    vertices: NDArray[np.float64]
    """[V, 3] metres, a closed surface; a file's float32 holds them exactly."""
    faces: NDArray[np.int64]
    """[F, 3] outward."""
    weights: NDArray[np.float64]
    """[V, J], at most four per vertex, rows sum to 1."""

    def place(self, poses: NDArray[np.float64], translation: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return world_from_joint [T, J, 4, 4] of poses [T, J, 3] (axis-angle to the parent) and a translation [T, 3]."""
        world = np.zeros((*poses.shape[:2], 4, 4))
        for j, parent in enumerate(self.parents):
            local = np.tile(np.eye(4), (len(poses), 1, 1))
            local[:, :3, :3] = Rotation.from_rotvec(poses[:, j]).as_matrix()
            local[:, :3, 3] = self.joints[j] + translation if parent < 0 else self.joints[j] - self.joints[parent]
            world[:, j] = local if parent < 0 else world[:, parent] @ local
        return world

    def posed(self, motion: AnimalMotion) -> NDArray[np.float64]:
        """Return the vertices [T, V, 3] in every frame."""
        matrices = self.place(motion.poses, motion.translation)
        matrices[..., :3, 3] -= np.einsum("tjab,jb->tja", matrices[..., :3, :3], self.joints)
        blended = np.einsum("vj,tjab->tvab", self.weights, matrices[..., :3, :])
        return np.einsum("tvab,vb->tva", blended[..., :3], self.vertices) + blended[..., 3]


@dataclass(frozen=True, eq=False)
class AnimalMotion:
    """Poses [T, J, 3], axis-angle relative to the parent, radians, and translation [T, 3], metres, at 30 frames per second."""

    name: str
    poses: NDArray[np.float64]
    translation: NDArray[np.float64]


def _bones() -> dict[str, tuple[str, NDArray, NDArray, float, float]]:
    bones = dict(_BODY)
    for end, leg, above in (("front", _FRONT, "chest"), ("hind", _HIND, "pelvis")):
        for side, sign in (("l", 1.0), ("r", -1.0)):
            parent = above
            for part, (place, tip, start_radius, end_radius) in leg.items():
                name = f"{side}_{end}_{part}"
                bones[name] = (parent, (sign * place[0], *place[1:]), tip, start_radius, end_radius)
                parent = name
    return {name: (p, np.array(at), np.array(tip), r0, r1) for name, (p, at, tip, r0, r1) in bones.items()}


def _distances(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance [N, J] to the surface of each bone's capsule, negative inside."""
    columns = []
    for _, at, tip, start_radius, end_radius in _bones().values():
        along = np.clip((points - at) @ tip / (tip @ tip), 0, 1)
        radius = start_radius + along * (end_radius - start_radius)
        columns.append(np.linalg.norm(points - at - along[:, None] * tip, axis=1) - radius)
    return np.stack(columns, 1)


@lru_cache(maxsize=4)
def make_animal(spacing: float = 0.0225) -> Animal:
    """Make the animal; `spacing` of the grid in metres: 0.0225 gives 3,818 vertices, 0.08 only 278 of a still closed shape."""
    bones = _bones()
    names = tuple(bones)
    joints = np.stack([bone[1] for bone in bones.values()])
    low, high = joints.min(0) - 0.24, joints.max(0) + 0.26
    axes = [np.arange(a, b, spacing) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    distances = _distances(grid.reshape(-1, 3))
    field = -_SMOOTH * np.log(np.exp(-np.minimum(distances, 1.0) / _SMOOTH).sum(1))
    vertices, faces, _, _ = marching_cubes(field.reshape(grid.shape[:3]), 0.0, spacing=(spacing,) * 3)
    vertices = (vertices + low).astype(np.float32).astype(np.float64)
    weights = np.exp(-_distances(vertices) / _BLEND)
    weights = np.where(weights >= np.sort(weights, 1)[:, -4:-3], weights, 0.0)
    weights /= weights.sum(1, keepdims=True)
    parents = tuple(names.index(bone[0]) if bone[0] else -1 for bone in bones.values())
    return Animal(names, parents, joints, vertices, faces.astype(np.int64), weights)


def animal_motion(name: str, frames: int = 48) -> AnimalMotion:
    """Make one of `ANIMAL_CLIPS`; `frames` of one whole cycle (walk, trot) or of one act (sniff, sit)."""
    names = tuple(_bones())
    poses, translation = np.zeros((frames, len(names), 3)), np.zeros((frames, 3))

    def turn(joint: str, x: NDArray | float = 0.0, y: NDArray | float = 0.0, z: NDArray | float = 0.0) -> None:
        # A positive x turns what hangs down backwards, and what points forwards down.
        poses[:, names.index(joint)] += np.stack(np.broadcast_arrays(x, y, z, np.zeros(frames))[:3], 1)

    t = np.arange(frames) / frames
    if name in ("walk", "trot"):
        swing, lift, stride = (0.40, 0.55, 0.7) if name == "walk" else (0.60, 0.95, 1.3)
        phases = (0.0, 0.5, 0.75, 0.25) if name == "walk" else (0.0, 0.5, 0.5, 0.0)
        for (side, end), phase in zip((("l", "front"), ("r", "front"), ("l", "hind"), ("r", "hind")), phases, strict=True):
            angle = 2 * np.pi * (t + phase)
            bend = lift * np.maximum(0.0, np.cos(angle)) ** 2
            turn(f"{side}_{end}_upper", x=-swing * np.sin(angle) - (0.4 * bend if end == "hind" else 0.2 * bend))
            turn(f"{side}_{end}_lower", x=bend if end == "front" else 0.8 * bend)
            turn(f"{side}_{end}_paw", x=0.5 * bend)
        beat = 2 * np.pi * t * (1 if name == "walk" else 2)
        turn("spine", x=0.05 * np.sin(beat), y=0.08 * np.sin(2 * np.pi * t))
        turn("neck", x=0.10 * np.sin(beat + 1))
        turn("tail1", x=0.2, y=0.3 * np.sin(beat))
        turn("tail2", y=0.4 * np.sin(beat - 0.8))
        translation[:, 2] = stride * t
        translation[:, 1] = 0.02 * np.cos(2 * beat) - 0.02
    elif name == "sniff":
        down = np.sin(np.pi * t) ** 0.7
        sway = 0.35 * np.sin(4 * np.pi * t) * down
        turn("chest", x=0.25 * down)
        turn("neck", x=1.15 * down, y=sway)
        turn("head", x=-0.25 * down, y=sway)
        turn("tail1", x=0.5 * down, y=0.5 * np.sin(12 * np.pi * t))
        turn("l_front_upper", x=-0.45 * down)
        turn("l_front_lower", x=0.35 * down)
        turn("r_front_upper", x=0.1 * down)
    elif name == "sit":
        down = np.clip(2 * t, 0, 1) ** 2 * (3 - 2 * np.clip(2 * t, 0, 1))
        turn("pelvis", x=-0.60 * down)
        turn("chest", x=0.10 * down)
        turn("head", x=0.35 * down, y=0.6 * np.sin(2 * np.pi * t) * down)
        for side in "lr":
            turn(f"{side}_hind_upper", x=-0.65 * down)
            turn(f"{side}_hind_lower", x=1.75 * down)
            turn(f"{side}_hind_paw", x=-0.50 * down)
            turn(f"{side}_front_upper", x=0.40 * down)
        turn("tail1", x=0.6 * down, y=0.4 * np.sin(6 * np.pi * t))
        translation[:, 1] = -0.24 * down
    else:
        raise ValueError(f"no motion {name}; there are {', '.join(ANIMAL_CLIPS)}")
    return AnimalMotion(name, poses, translation)
