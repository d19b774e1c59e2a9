"""A person who moves, as unordered points, for tests of fitting."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
import trimesh

from snarfcli.bodies import builtin_body
from snarfcli.motions import builtin_motion
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.matches import Agreement, agreement
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.solver import PosePrior, fit_state, scales

BETAS = np.array([1.5, -1.0, 0.5, 1.0, 0.0, -0.5, 0.0, 0.0, 0.0, 0.0])
PRIOR = PosePrior.weak(24)


@lru_cache
def surface(count: int = 400) -> BodySurface:
    """Return vertices of the built-in body."""
    return BodySurface.from_body(builtin_body(), count)


class Person:
    """The scans of a built-in motion.

    Args:
        name: of the motion.
        frames: number of frames.
        frame_rate: per second.
        count: points of each scan.
        cloth_m: distance of the scan from the body, metres.
    """

    def __init__(self, name: str, frames: int, frame_rate: float = 30.0, count: int = 1500, cloth_m: float = 0.0) -> None:
        motion = builtin_motion(name, 3, duration_s=frames / frame_rate, frame_rate=frame_rate)
        self.count, self.cloth_m = count, cloth_m
        self.states = [BodyState.from_pose(*pair, BETAS) for pair in zip(motion.poses, motion.translation, strict=True)]

    def __len__(self) -> int:
        return len(self.states)

    def __getitem__(self, index: int) -> ScanPoints:
        state, body = self.states[index], builtin_body().to(torch.float64)
        vertices = body.pose(state.pose[None], state.betas, state.translation[None]).vertices[0].numpy()
        mesh = trimesh.Trimesh(vertices, body.faces.numpy(), process=False)
        points, faces = trimesh.sample.sample_surface(mesh, self.count, seed=index)[:2]
        normals = mesh.face_normals[faces]
        return ScanPoints.sampled(points + self.cloth_m * normals, normals, self.count, index)

    def errors_m(self, states: list[BodyState]) -> np.ndarray:
        """Return the mean joint error of each frame, metres."""
        bodies = surface(1)
        pairs = zip(states, self.states, strict=True)
        return np.array([np.linalg.norm(bodies.joints(found) - bodies.joints(true), axis=1).mean() for found, true in pairs])


@dataclass(frozen=True)
class Found:
    """What a finder returns."""

    state: BodyState
    agreement: Agreement


class NearFinder:
    """Starts from a state that is given for each scan, and counts its calls.

    Args:
        starts: states from which single frames are fitted, in order of the calls; the last one again when they are used up.
        body: the body.
    """

    def __init__(self, starts: list[BodyState], body: BodySurface) -> None:
        self.starts, self.body, self.calls = starts, body, 0

    def find(self, scan: ScanPoints, *, betas=None, clothes_m: float = 0.0, near=()) -> Found:
        start = self.starts[min(self.calls, len(self.starts) - 1)]
        self.calls += 1
        start = BodyState(start.rotations, start.translation, np.zeros(10) if betas is None else betas)
        found = fit_state(
            self.body, start, scan, scales(0.15, 0.04, 10), PRIOR, shape_is_free=betas is None, clothes_m=clothes_m
        )
        return Found(found, agreement(self.body, found, scan))

    def recover(self, scan: ScanPoints, state: BodyState, *, clothes_m: float = 0.0) -> Found:
        return Found(state, agreement(self.body, state, scan))
