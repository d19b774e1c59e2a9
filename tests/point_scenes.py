"""Points on the surface of the built-in body, and how well a surface around them agrees with it."""

from __future__ import annotations

import functools

import numpy as np
import torch

from snarfcli.bodies import builtin_body
from snarfcli.sampling import oriented_surface_samples, winding_numbers

__all__ = ["POSE", "body_mesh", "sampled", "volume_iou"]

Mesh = tuple[np.ndarray, np.ndarray]

POSE = torch.zeros(1, 24, 3, dtype=torch.float64)
"""Raised arms and a bent knee, axis-angle, radians."""
POSE[0, [5, 16, 17]] = torch.tensor([[0.9, 0.0, 0.0], [0.0, 0.0, -0.7], [0.0, 0.0, 0.5]], dtype=torch.float64)


@functools.cache
def body_mesh() -> Mesh:
    """Return vertices [V, 3] and faces [F, 3] of the body in `POSE`, metres."""
    body = builtin_body().to(torch.float64)
    return body.pose(POSE).vertices[0].numpy(), body.faces.numpy()


def sampled(mesh: Mesh, count: int, noise: float = 0.0) -> Mesh:
    """Return random points [N, 3] on a mesh, moved by normal noise, and the true normals [N, 3]."""
    generator = np.random.default_rng(0)
    points, normals = oriented_surface_samples(*mesh, count, generator)
    return points + noise * generator.standard_normal(points.shape), normals


def volume_iou(mesh: Mesh, true: Mesh, lowest: float = -np.inf) -> float:
    """Return the intersection over union of two volumes above a height, from random points in the box of the true one."""
    low, high = true[0].min(axis=0) - 0.05, true[0].max(axis=0) + 0.05
    low[1] = max(low[1], lowest)
    points = low + (high - low) * np.random.default_rng(1).random((20_000, 3))
    one, other = (winding_numbers(*each, points) > 0.5 for each in (mesh, true))
    return float((one & other).sum() / (one | other).sum())
