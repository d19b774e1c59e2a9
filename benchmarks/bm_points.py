"""Closed surfaces around points: time, and IoU with the true mesh, against screened Poisson reconstruction and winding numbers.

    python benchmarks/bm_points.py                 about ten minutes on one core

Points are drawn on six poses of built-in subjects, with and without 5 mm of noise. Normals are true, or their sides are those
that the bones say, as in `snarf preprocess`, or those that the points themselves say, as at the start of `snarf fit`. The
IoU is that of 60,000 points in a box around the mesh, and of 20,000 points near its surface (1 cm of normal noise).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
import pymeshlab
import torch
from common import arguments, print_machine, print_table
from numpy.typing import NDArray

from snarfcli.bodies import forward_kinematics
from snarfcli.datasets.builtin import builtin_subject
from snarfcli.datasets.subjects import SequenceSpec, SubjectData
from snarfcli.point_clouds import bone_normals, close_surface, estimate_normals
from snarfcli.point_clouds.neighbours import point_areas
from snarfcli.sampling import oriented_surface_samples, winding_numbers

_POSES = (
    ("punching", "50002", 0.3), ("jumping_jacks", "50004", 0.4), ("high_kicks", "50009", 0.5),
    ("splits", "50002", 0.5), ("arms_behind_back", "50007", 0.6), ("sits_and_twists", "50020", 0.5),
)  # fmt: skip
Inside = Callable[[NDArray], NDArray]
"""Returns which of some points [N, 3] are inside."""


@dataclass(frozen=True)
class Scan:
    """Points on a mesh."""

    points: NDArray
    """[N, 3], metres."""
    normals: NDArray
    """[N, 3], true, outward."""
    joints: NDArray
    """[J, 3], metres."""
    parents: tuple[int, ...]
    """J parents."""


def surface_test(vertices: NDArray, faces: NDArray) -> Inside:
    """Return the inside test of a mesh."""
    return lambda at: winding_numbers(vertices, faces, at) > 0.5


def poisson(points: NDArray, normals: NDArray, depth: int, samples: float) -> Inside:
    """Return the inside test of a screened Poisson reconstruction."""
    meshes = pymeshlab.MeshSet(verbose=False)  # pyright: ignore[reportAttributeAccessIssue]
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=points, v_normals_matrix=normals))  # pyright: ignore[reportAttributeAccessIssue]
    meshes.generate_surface_reconstruction_screened_poisson(depth=depth, samplespernode=samples, threads=1)
    return surface_test(meshes.current_mesh().vertex_matrix(), meshes.current_mesh().face_matrix())


def winding(points: NDArray, normals: NDArray) -> Inside:
    """Return the inside test of the winding number of oriented points."""
    areas = point_areas(points)
    return lambda at: np.asarray(igl.fast_winding_number(points, normals, areas, at, 2, 2.0)).ravel() > 0.5


def closed(scan: Scan, normals: NDArray) -> Inside:
    """Return the inside test of our closed surface."""
    return surface_test(*close_surface(scan.points, normals))


METHODS: dict[str, Callable[[Scan], Inside]] = {
    "close_surface": lambda scan: closed(scan, scan.normals),
    "close_surface, sides by bones": lambda scan: closed(scan, bone_normals(scan.points, scan.joints, scan.parents)),
    "close_surface, sides by points": lambda scan: closed(scan, estimate_normals(scan.points)),
    "Poisson, depth 7": lambda scan: poisson(scan.points, scan.normals, 7, 1.5),
    "Poisson, depth 8": lambda scan: poisson(scan.points, scan.normals, 8, 1.0),
    "winding numbers": lambda scan: winding(scan.points, scan.normals),
}


def joints_of(data: SubjectData, spec: SequenceSpec, frame: int) -> NDArray:
    """Return the joints [J, 3] of a frame, metres."""
    poses, translation = (torch.from_numpy(array[[frame]]) for array in (spec.motion.poses, spec.motion.translation))
    return forward_kinematics(poses, data.skeleton.joints_rest.double(), data.skeleton.parents, translation)[0][0].numpy()


def measure(method: str, count: int, noise_m: float) -> NDArray[np.float64]:
    """Return seconds, IoU in the box and IoU near the surface [6, 3] of a method on each pose."""
    rows = []
    for motion, subject, share in _POSES:
        data = builtin_subject(subject)
        (spec,) = (spec for spec in data.sequences if spec.name == motion)
        frame = int(share * spec.motion.num_frames)
        mesh = spec.meshes[frame]
        draws = np.random.default_rng(0)
        points, normals = oriented_surface_samples(*mesh, count, draws)
        points = points + noise_m * draws.standard_normal(points.shape)
        low, high = mesh[0].min(axis=0) - 0.05, mesh[0].max(axis=0) + 0.05
        near = oriented_surface_samples(*mesh, 20_000, draws)[0]
        places = (low + (high - low) * draws.random((60_000, 3)), near + 0.01 * draws.standard_normal(near.shape))
        scan = Scan(points, normals, joints_of(data, spec, frame), data.skeleton.parents)
        start = time.process_time()
        inside = METHODS[method](scan)
        seconds = time.process_time() - start
        pairs = [(inside(at), surface_test(*mesh)(at)) for at in places]
        rows.append([seconds, *((one & other).sum() / (one | other).sum() for one, other in pairs)])
    return np.array(rows)


def main() -> None:
    """Measure all methods and print a table; winding numbers are computed at the points, so they have no time of their own."""
    options = arguments(__doc__ or Path(__file__).name, points={"type": int, "nargs": "*", "default": [2000, 4000, 10000]})
    table = []
    for count in options.points:
        for noise_m in (0.0, 0.005):
            for method in METHODS:
                rows = measure(method, count, noise_m)
                shares = [f"{100 * value:.1f}" for value in (*rows.mean(axis=0)[1:], rows[:, 2].min())]
                table.append([f"{count}", f"{1000 * noise_m:g}", method, f"{rows[:, 0].mean():.2f}", *shares])
    print_machine()
    print_table(["points", "noise, mm", "method", "seconds", "IoU box, %", "IoU surface, %", "worst, %"], table)


if __name__ == "__main__":
    main()
