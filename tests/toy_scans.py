"""Folders of scans of the built-in body near its rest pose, and a finder that needs no search for them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import trimesh

from snarfcli.bodies import builtin_body
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.matches import agreement
from snarfcli.registration.pose_library import PoseLibrary
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.solver import PosePrior, fit_state, scales
from snarfcli.registration.starts import Found, PoseFinder
from snarfcli.sampling import oriented_surface_samples
from snarfcli.scanned_subjects.written import read_fitted, read_made

BETAS = np.array([1.0, -0.8, 0.5, 0.7, 0, 0, 0, 0, 0, 0])
Cloud = tuple[np.ndarray, np.ndarray]
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rotation from y up to z up."""


def toy_poses(frames: int, phase: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return poses [T, 24, 3] that wave a little, and places [T, 3], metres."""
    names = builtin_body().joint_names
    time = phase + 0.4 * np.arange(frames)
    poses, places = np.zeros((frames, 24, 3)), np.zeros((frames, 3))
    poses[:, names.index("l_shoulder"), 2] = -0.4 + 0.2 * np.sin(time)
    poses[:, names.index("r_elbow"), 1] = 0.3 + 0.2 * np.cos(time)
    places[:, 0] = 0.03 * time
    return poses, places


def toy_mesh(pose: np.ndarray, place: np.ndarray, betas: np.ndarray = BETAS) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [V, 3], metres, and faces [F, 3] of the body."""
    body = builtin_body()
    posed = body.pose(torch.from_numpy(pose[None]).float(), betas, torch.from_numpy(place[None]).float())
    return posed.vertices[0].double().numpy(), body.faces.numpy()


def write_scans(
    folder: Path,
    frames: int = 2,
    *,
    phase: float = 0.0,
    unit_m: float = 1.0,
    up: str = "y",
    betas: np.ndarray = BETAS,
    one_topology: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Write one mesh per frame, and return the poses and places.

    Without `one_topology`, every mesh lacks other faces.
    """
    folder.mkdir(parents=True)
    poses, places = toy_poses(frames, phase)
    for frame in range(frames):
        vertices, faces = toy_mesh(poses[frame], places[frame], betas)
        vertices = (vertices if up == "y" else vertices @ Z_UP.T) / unit_m
        faces = faces if one_topology else np.delete(faces, 500 + 20 * frame, 0)
        trimesh.Trimesh(vertices, faces, process=False).export(folder / f"{frame}.ply")
    return poses, places


def person(count: int = 3000) -> Cloud:
    """Return points on the body and normals there."""
    poses, places = toy_poses(1)
    return oriented_surface_samples(*toy_mesh(poses[0], places[0]), count, np.random.default_rng(0))


def floor(height: float, side: float = 2.0, count: int = 2000, noise: float = 0.0, slope: float = 0.0) -> Cloud:
    """Return points [P, 3] on a square floor with y up, and normals there."""
    draws = np.random.default_rng(1)
    points = np.stack(
        [draws.uniform(-side / 2, side / 2, count), np.zeros(count), draws.uniform(-side / 2, side / 2, count)], 1
    )
    points[:, 1] = height + slope * points[:, 0]
    normals = np.tile([-slope, 1.0, 0.0], (count, 1)) + draws.normal(0, 4 * noise, (count, 3))
    return points + draws.normal(0, noise, points.shape), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def together(*clouds: Cloud) -> Cloud:
    """Return all points and normals of several clouds."""
    points, normals = (np.concatenate(arrays) for arrays in zip(*clouds, strict=True))
    return points, normals


class QuickFinder(PoseFinder):
    """Starts from the pose that the scans above have on average."""

    def __init__(self, surface: BodySurface, library: PoseLibrary, prior: PosePrior) -> None:
        self.surface, self.prior = surface, prior

    def find(
        self,
        scan: ScanPoints,
        *,
        betas: np.ndarray | None = None,
        clothes_m: float = 0.0,
        near: Sequence[BodyState] = (),
    ) -> Found:
        pose = toy_poses(2)[0].mean(0) * (self.surface.num_joints == 24)
        shape = np.zeros(self.surface.num_betas) if betas is None else betas
        start = BodyState.from_pose(pose, np.zeros(3), shape)
        posed = self.surface.posed(start).points
        start = BodyState(start.rotations, scan.centre - (posed.max(0) + posed.min(0)) / 2, shape)
        state = fit_state(
            self.surface,
            start,
            scan,
            scales(0.1, 0.03, 12),
            self.prior,
            shape_is_free=betas is None and self.surface.num_betas > 0,
            clothes_m=clothes_m,
        )
        return Found(state, agreement(self.surface, state, scan))


def joint_error_mm(place: Path, truth: dict[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
    """Return the mean distance between the fitted joints of a subject and the true ones by sequence, millimetres."""
    made = read_made(place)
    assert made is not None
    errors = {}
    for name, (poses, places) in truth.items():
        fitted = read_fitted(place / name, made, 24)
        assert fitted is not None
        body = builtin_body().to(torch.float64)
        found = body.pose(fitted.poses, made.betas, fitted.translation).joints
        errors[name] = 1000 * float((found - body.pose(poses, BETAS, places).joints).norm(dim=2).mean())
    return errors
