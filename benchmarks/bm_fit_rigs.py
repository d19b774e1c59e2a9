"""How well rigs are fitted to unordered points of their own motions: animals and other characters in glTF files.

    python benchmarks/bm_fit_rigs.py RIGS --clips Walk Run --frames 60
    python benchmarks/bm_fit_rigs.py RIGS --known others

Every frame of a motion becomes 4,000 points on the surface of the posed mesh, 1.8 m long, in random order. The rig, which is
10 % too small at first, is fitted to them: from nowhere in a few frames, then from frame to frame. The poses that are known at
the start are the rest pose alone, or also those of the rig's other motions, or of all. Distances are those of the joints that
move a part of the mesh, in millimetres. With `--vertices`, the vertices of the posed mesh are given in their order instead.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from common import print_machine, print_table
from numpy.typing import NDArray

from snarfcli.datasets.posed_meshes import RigMeshes
from snarfcli.datasets.rigged import RIG_SUFFIXES, read_rigged_files
from snarfcli.registration.body_surface import BodyState
from snarfcli.registration.rigs import RigSurface, read_rig
from snarfcli.registration.same_topology import fit_one_topology
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.solver import PosePrior
from snarfcli.registration.starts import PoseFinder
from snarfcli.registration.tracker import FittedSequence, fit_sequence

__all__ = ["RigClipCase", "cases", "errors_mm", "follow", "follow_vertices"]

KNOWN = ("rest", "others", "all")
_LENGTH_M = 1.8
_TOO_SMALL = 0.9
_POINTS = 4000
_VERTICES = 1200
_GOOD_MM, _FAIR_MM = 15, 25


@dataclass(frozen=True, eq=False)
class RigClipCase:
    """One motion of one rig."""

    name: str
    motion: str
    rig: RigSurface
    """As long as a person."""
    meshes: RigMeshes
    """[T], posed, metres."""
    joints: NDArray[np.float64]
    """[T, J, 3], metres."""

    def __len__(self) -> int:
        return len(self.meshes)

    def __getitem__(self, frame: int) -> ScanPoints:
        mesh = trimesh.Trimesh(*self.meshes[frame], process=False)
        points, faces = trimesh.sample.sample_surface(mesh, _POINTS, seed=frame)[:2]
        return ScanPoints.sampled(points, mesh.face_normals[faces], _POINTS, frame)


def cases(folder: Path, clips: Sequence[str], frames: int) -> Iterator[RigClipCase]:
    """Yield the motions of all rigs in a folder; those in `clips`, or all without them, cut to a number of frames."""
    for path in sorted(path for path in folder.iterdir() if path.suffix.lower() in RIG_SUFFIXES):
        rig = read_rig(path)
        scale = _LENGTH_M / rig.length_m
        rig = rig.resized(scale)
        rest = rig.skeleton.joints_rest.numpy()
        for name, clip in read_rigged_files([path]).clips:
            if clip.posed_from_rest is None or (clips and name not in clips):
                continue
            moved = clip.posed_from_rest[:frames].copy()
            moved[..., :3, 3] *= scale
            joints = np.einsum("tjab,jb->tja", moved[..., :3, :3], rest) + moved[..., :3, 3]
            yield RigClipCase(f"{path.stem} {name}", name, rig, RigMeshes(rig.vertices, rig.faces, rig.weights, moved), joints)


def follow(case: RigClipCase, known: str) -> FittedSequence:
    """Fit a rig that is too small to the unordered points of a motion; `known` is one of `KNOWN`."""
    rig = case.rig.resized(_TOO_SMALL)
    surface, prior = rig.surface(_VERTICES), PosePrior.weak(rig.skeleton.num_joints)
    unknown = {"rest": [name for name, _ in rig.motions], "others": [case.motion], "all": []}[known]
    library = rig.library_without(unknown)
    return fit_sequence(surface, case, PoseFinder(surface, library, prior), prior, betas=None)


def follow_vertices(case: RigClipCase) -> FittedSequence:
    """Fit a rig that is too small to the vertices of its own mesh."""
    rig = case.rig.resized(_TOO_SMALL)
    return fit_one_topology(rig.surface(10**7), rig.faces, rig.faces, lambda frame: case.meshes[frame][0], len(case), {})


def errors_mm(case: RigClipCase, fitted: FittedSequence) -> NDArray[np.float64]:
    """Return the mean distance of the joints in each frame [T], millimetres."""
    surface = case.rig.resized(_TOO_SMALL).surface(1)
    moving = [joint for joint in range(surface.num_joints) if joint not in case.rig.skeleton.idle]
    found = np.stack(
        [
            surface.joints(BodyState.from_pose(pose, translation, fitted.betas))
            for pose, translation in zip(fitted.poses, fitted.translation, strict=True)
        ]
    )
    return 1000 * np.linalg.norm(found - case.joints, axis=2)[:, moving].mean(1)


def main() -> None:
    parser = argparse.ArgumentParser(description="Fit rigs to unordered points of their own motions.")
    parser.add_argument("folder", type=Path, help="folder of rigged glTF files")
    parser.add_argument("--clips", nargs="*", default=(), help="motions (default: all)")
    parser.add_argument("--frames", type=int, default=60, help="maximum number of frames of a motion")
    parser.add_argument("--known", choices=KNOWN, default="rest", help="poses to start from: of which of the rig's motions")
    parser.add_argument("--vertices", action="store_true", help="fit to the vertices in their order instead")
    options = parser.parse_args()
    print_machine()
    rows = []
    for case in cases(options.folder, options.clips, options.frames):
        started = time.process_time()
        fitted = follow_vertices(case) if options.vertices else follow(case, options.known)
        seconds = (time.process_time() - started) / len(case)
        errors = errors_mm(case, fitted)
        rows.append(
            [
                case.name,
                len(case),
                f"{errors.mean():.1f}",
                f"{errors.max():.1f}",
                f"{100 * (errors < _GOOD_MM).mean():.0f} %",
                f"{100 * (errors < _FAIR_MM).mean():.0f} %",
                f"{100 * fitted.is_trusted.mean():.0f} %",
                f"{seconds:.2f}",
            ]
        )
        print("  ".join(map(str, rows[-1])), flush=True)
    head = ["motion", "frames", "mean, mm", "worst frame, mm", f"< {_GOOD_MM} mm", f"< {_FAIR_MM} mm", "trusted", "s per frame"]
    print_table(head, rows)


if __name__ == "__main__":
    main()
