"""Scans of the built-in body in any state."""

from __future__ import annotations

from functools import cache

import torch
import trimesh

from snarfcli.bodies import Body, builtin_body
from snarfcli.registration.body_surface import BodyState
from snarfcli.registration.scan_points import ScanPoints


@cache
def exact_body() -> Body:
    """Return the built-in body in float64."""
    return builtin_body().to(torch.float64)


def body_scan(state: BodyState, count: int = 2500, seed: int = 0) -> ScanPoints:
    """Return points on the surface of the built-in body."""
    body = exact_body()
    vertices = body.pose(state.pose[None], state.betas, state.translation[None]).vertices[0].numpy()
    mesh = trimesh.Trimesh(vertices, body.faces.numpy(), process=False)
    points, faces = trimesh.sample.sample_surface(mesh, count + count // 5, seed=seed)[:2]
    return ScanPoints.sampled(points, mesh.face_normals[faces], count)
