"""Meshes of known volume, and a subject that is a bending capsule: two bones, three short motions."""

from __future__ import annotations

import numpy as np
import torch

from snarfcli.bodies import Body
from snarfcli.datasets.subjects import SubjectData, body_sequence, body_template
from snarfcli.motions import Motion

RADIUS = 0.1
LENGTH = 0.5


def capsule_mesh(length: float, radius: float, axis: int = 0, around: int = 24, along: int = 8, cap: int = 6):
    """Return vertices [V, 3] and outward faces [F, 3] of a closed capsule from the origin along an axis.

    `length` is that of the straight part; 0 makes a sphere. The mesh is inscribed: every vertex lies on the capsule.
    """
    angles = np.linspace(-np.pi / 2, 0, cap + 1)
    profile = [(radius * np.sin(a), radius * np.cos(a)) for a in angles[1:]]
    profile += [(length * s, radius) for s in np.linspace(0, 1, along + 1)[1:] if length > 0]
    profile += [(length + radius * np.sin(-a), radius * np.cos(a)) for a in angles[1:-1][::-1]]
    turn = 2 * np.pi * np.arange(around) / around
    rings = [np.stack([np.full(around, x), r * np.cos(turn), r * np.sin(turn)], 1) for x, r in profile]
    vertices = np.concatenate([[[-radius, 0, 0]], *rings, [[length + radius, 0, 0]]])
    last = len(vertices) - 1
    faces = []
    for k in range(around):
        n = (k + 1) % around
        faces.append((0, 1 + n, 1 + k))
        for ring in range(len(rings) - 1):
            a, b = 1 + ring * around, 1 + (ring + 1) * around
            faces += [(a + k, a + n, b + n), (a + k, b + n, b + k)]
        top = 1 + (len(rings) - 1) * around
        faces.append((top + k, top + n, last))
    return np.roll(vertices, axis, axis=1), np.array(faces, np.int32)


def mesh_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the volume that a closed mesh of outward faces encloses."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def crossing_capsules(length: float = 1.0, radius: float = 0.2, around: int = 64):
    """Return one mesh of two capsules that cross at right angles; their common part has the volume 16/3 radius^3."""
    first, faces = capsule_mesh(length, radius, 0, around)
    second, _ = capsule_mesh(length, radius, 1, around)
    first, second = first - (length / 2, 0, 0), second - (0, length / 2, 0)
    return np.concatenate([first, second]), np.concatenate([faces, faces + len(first)])


def toy_body() -> Body:
    """Return a capsule along x with a joint at its start and one in its middle."""
    vertices, faces = capsule_mesh(2 * LENGTH, RADIUS, around=12, along=12, cap=3)
    second = 1 / (1 + np.exp(-(vertices[:, 0] - LENGTH) / 0.05))
    joints = np.array([[0.0, 0, 0], [LENGTH, 0, 0]])
    # the regressor must reproduce the joints from the vertices: rings are symmetric, so weight first and last vertex
    ends = vertices[[0, -1], 0]
    regressor = np.zeros((2, len(vertices)))
    regressor[:, -1] = (joints[:, 0] - ends[0]) / (ends[1] - ends[0])
    regressor[:, 0] = 1 - regressor[:, -1]
    return Body(
        v_template=torch.tensor(vertices, dtype=torch.float32),
        faces=torch.tensor(faces, dtype=torch.int64),
        weights=torch.tensor(np.stack([1 - second, second], 1), dtype=torch.float32),
        parents=(-1, 0),
        joint_names=("root", "middle"),
        joint_regressor=torch.tensor(regressor, dtype=torch.float32),
        shapedirs=torch.zeros(len(vertices), 3, 1),
        posedirs=torch.zeros(len(vertices), 3, 9),
    )


def bending(name: str, frames: int, reach_rad: float) -> Motion:
    """Return a motion that bends the second bone about z and drifts a little."""
    poses = np.zeros((frames, 2, 3))
    poses[:, 1, 2] = reach_rad * np.sin(np.linspace(0, 2 * np.pi, frames))
    translation = np.zeros((frames, 3))
    translation[:, 1] = np.linspace(0, 0.1, frames)
    return Motion(name, poses, translation, 30.0)


def toy_subject(subject: str = "toy", train_frames: int = 34, body: Body | None = None) -> SubjectData:
    """Return a subject with one training sequence, one held out and one that bends further."""
    body = body or toy_body()
    betas = np.zeros(1)
    skeleton = body.skeleton(betas)
    motions = (("train", "bend", train_frames, 1.0), ("test", "wave", 3, 0.8), ("ood", "fold", 2, 1.6))
    specs = tuple(
        body_sequence(name, split, bending(name, frames, reach), body, betas) for split, name, frames, reach in motions
    )
    return SubjectData("builtin", subject, skeleton, specs, body_template(body, betas, skeleton), betas)
