"""A picture of the worst and the best frames of a fit: the scan and the fitted body side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from snarfcli.meshing.mesh import Mesh
from snarfcli.registration.body_surface import BodyState
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.rendering import Camera, contact_sheet, render, write_png
from snarfcli.scanned_subjects.fit_report import SequenceReport
from snarfcli.scanned_subjects.fitter import Fitter
from snarfcli.scanned_subjects.subject_scans import SubjectScans
from snarfcli.scanned_subjects.written import FitMade
from snarfcli.texts import one_line

__all__ = ["write_fit_figure"]

_ROWS = 3
_PANEL = 320  # pixels
_WORST_PARTS = 8  # of a sequence; at most one frame of each is among the worst
_DRAWN_POINTS = 20_000
_DISC_M = (0.004, 0.02)  # radius of a point
_DISC = 0.75  # the same, times the distance between neighbours: most gaps close, and fingers stay apart


def write_fit_figure(
    path: Path,
    subject: str,
    fitter: Fitter,
    made: FitMade,
    scans: SubjectScans,
    reports: Sequence[SequenceReport],
) -> None:
    """Write a PNG with the worst frames on the left and the best on the right, by residual, whole or not at all."""
    worst, best = _extremes(reports)
    rows: list[list[NDArray[np.uint8] | None]] = [[] for _ in worst]
    captions: list[list[str | None]] = [[] for _ in worst]
    for group in (worst, best):
        for row, (report, frame) in enumerate(group):
            rows[row] += _draw(fitter, made, scans, report, frame)
            residual = 1000 * report.fitted.residual_m[frame]
            trust = "" if report.fitted.is_trusted[frame] else ", not trusted"
            captions[row] += [f"{one_line(report.name, 40)}, frame {frame}", f"{residual:.1f} mm{trust}"]
    width = 4 if best else 2
    for row, caption in zip(rows, captions, strict=True):
        row += [None] * (width - len(row))
        caption += [None] * (width - len(caption))
    labels = ["worst: scan", "fitted body", *(["best: scan", "fitted body"] if best else [])]
    title = f"fit of {one_line(subject, 60)}"
    write_png(path, contact_sheet(rows, column_labels=labels, captions=captions, title=title))


def _extremes(reports: Sequence[SequenceReport]) -> tuple[list[tuple[SequenceReport, int]], list[tuple[SequenceReport, int]]]:
    """Return the worst frames, worst first, and the best ones, best first, at most one of each part of a sequence."""
    frames = [
        (float(residual), report, frame)
        for report in reports
        for frame, residual in enumerate(report.fitted.residual_m)
        if np.isfinite(residual)
    ]
    frames.sort(key=lambda one: (one[0], one[1].number, one[2]))
    count = min(_ROWS, max(1, len(frames) // 2))

    def pick(candidates: Sequence[tuple[float, SequenceReport, int]], parts: int) -> list[tuple[SequenceReport, int]]:
        chosen: dict[tuple[int, int], tuple[SequenceReport, int]] = {}
        for _, report, frame in candidates:
            part = (report.number, frame * parts // len(report.fitted.poses))
            chosen.setdefault(part, (report, frame))
        return list(chosen.values())[:count]

    worst = pick(frames[::-1], _WORST_PARTS)
    taken = {(report.number, frame) for report, frame in worst}
    others = [one for one in frames if (one[1].number, one[2]) not in taken]
    best = pick(others, -(-count // len(reports)))  # frames that fit well are often alike: few parts, far apart
    return worst, best[: len(worst)]


def _draw(
    fitter: Fitter, made: FitMade, scans: SubjectScans, report: SequenceReport, frame: int
) -> list[NDArray[np.uint8] | None]:
    """Return the pictures of the scan and of the body, from one camera."""
    sequence = replace(scans.sequence(report.number, made.world), count=_DRAWN_POINTS)
    scan = sequence[scans.usable(report.number).index(frame)]
    fitted = report.fitted
    body = Mesh(*fitter.mesh(BodyState.from_pose(fitted.poses[frame], fitted.translation[frame], made.betas)))
    both = np.concatenate([scan.points, body.vertices])
    camera, floor_y = Camera.framing(both), float(both[:, 1].min())
    return [render(mesh, camera, _PANEL, floor_y=floor_y) for mesh in (_discs(scan, camera), body)]


def _discs(scan: ScanPoints, camera: Camera) -> Mesh:
    """Return the points that face a camera as hexagons along the surface, larger where points are few."""
    apart = KDTree(scan.points).query(scan.points, 5)[0][:, -1]
    radius = float(np.clip(_DISC * np.median(apart), *_DISC_M))
    faces_camera = ((np.asarray(camera.position) - scan.points) * scan.normals).sum(1) > 0
    points, normals = scan.points[faces_camera], scan.normals[faces_camera]
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    across = np.cross(normals, helper)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    along = np.cross(normals, across)
    turn = np.pi * np.arange(6) / 3
    corners = points[:, None] + radius * (np.cos(turn)[:, None] * across[:, None] + np.sin(turn)[:, None] * along[:, None])
    fan = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    faces = 6 * np.arange(len(points))[:, None, None] + fan
    return Mesh(corners.reshape(-1, 3).astype(np.float32), faces.reshape(-1, 3).astype(np.int64))
