"""Decide what all frames of a subject share: the up axis, where the extent does not tell it, and the shape of the body."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from snarfcli.datasets.recorded_sequence import FileToWorld
from snarfcli.errors import UserError
from snarfcli.motions.up_axis import up_axis
from snarfcli.parallel import run_in_processes
from snarfcli.progress import progress
from snarfcli.registration.body_surface import BodySurface
from snarfcli.registration.same_topology import NoUsualFrames, prepare_follower
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.shape import fit_shape
from snarfcli.registration.starts import Found
from snarfcli.scanned_subjects.fit_workers import find_single_frames
from snarfcli.scanned_subjects.fitter import Fitter, RigFitter
from snarfcli.scanned_subjects.scan_files import topology_of
from snarfcli.scanned_subjects.subject_scans import SubjectScans
from snarfcli.scanned_subjects.surroundings import AXES
from snarfcli.scanned_subjects.written import FitMade
from snarfcli.texts import counted

__all__ = ["decide_shape", "resized", "rig_size"]

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

_FRAMES = 12  # that the shape is made from
_FRAMES_OF_UP = 4
_MOST_MISFIT = 0.3  # of a person: 500 to 4,000 points have 0.03 to 0.08, boxes, chairs and balls 0.5 to 1.1
_GOOD = 1.3  # times the misfit of the best frame: such frames tell the shape
_OTHERS = 2  # parts beside the subject that are tried as another person
_SHAPES_APART_M = 0.03  # mean distance between the bodies of two sequences


@dataclass(frozen=True)
class _Seen:
    """One frame with the body found in it."""

    sequence: int
    index: int  # among the usable frames
    scan: ScanPoints
    found: Found


def decide_shape(subject: str, scans: SubjectScans, fitter: Fitter, settings: dict[str, Any]) -> FitMade:
    """Find the body in a dozen frames of all sequences, and one shape for all.

    Args:
        subject: name of the subject, for messages.
        scans: its scans.
        fitter: the body.
        settings: of the fit, which are kept with the result.

    Raises:
        UserError: the scans show no person, or several.
    """
    if scans.shared_topology() == topology_of(len(fitter.whole.points_rest), fitter.faces):
        return _by_own_vertices(scans, fitter, settings)
    world = FileToWorld(scans.survey.scale, scans.survey.up or _up_by_fits(scans, fitter))
    seen = _find(scans, world, _FRAMES)
    best = min(one.found.agreement.misfit for one in seen)
    if best > _MOST_MISFIT:
        residual = min(one.found.agreement.residual_m for one in seen)
        what = "person" if scans.options.body.skeleton is None else "such body"
        raise UserError(
            f"no {what} in the scans of {subject}: in the best of {counted(len(seen), 'frame')} the body is "
            f"{1000 * residual:.0f} mm from the points on average, wanted less than 20; check data.scale (now {world.scale:g}) "
            f"and data.up (now {world.up}), or give another body or skeleton"
        )
    _check_others(subject, scans, world)
    _compare_sequences(scans, fitter.surface, seen)
    good = [one for one in seen if one.found.agreement.misfit <= _GOOD * best]
    return FitMade(_shape(scans, fitter, world, good), world, settings, scans.options.body.size)


def rig_size(scans: SubjectScans, fitter: RigFitter) -> float:
    """Return the factor that makes a rig about as large as what the scans show."""
    world = FileToWorld(scans.survey.scale, scans.survey.up or "y")
    points = [scans.sequence(number, world)[index] for number, index in scans.spread_frames(_FRAMES)]
    return fitter.rig.sized_to(points).length_m / fitter.rig.length_m


def resized(scans: SubjectScans, size: float) -> SubjectScans:
    """Return scans to which a rig is fitted that is made larger by a factor."""
    return replace(scans, options=replace(scans.options, body=replace(scans.options.body, size=size)))


def _shape(scans: SubjectScans, fitter: Fitter, world: FileToWorld, good: Sequence[_Seen]) -> Array:
    """Return one shape [S] for all frames, from those in which the body was found."""
    if not fitter.surface.num_betas:
        return np.zeros(0)
    clothes_m = scans.options.clothes_m
    shape = fit_shape(fitter.surface, [(one.scan, one.found.state) for one in good], fitter.prior, clothes_m=clothes_m)
    if not scans.shared_topology():
        return shape.betas
    vertices = [scans.sequence(one.sequence, world).vertices(one.index) for one in good]
    faces = scans.sequence(good[0].sequence, world).faces()
    try:
        return prepare_follower(fitter.whole, fitter.faces, faces, vertices, shape.states, clothes_m=clothes_m).betas
    except NoUsualFrames:
        return shape.betas


def _by_own_vertices(scans: SubjectScans, fitter: Fitter, settings: dict[str, Any]) -> FitMade:
    """Return the shape and the up axis from scans with the vertices of the body itself, in which nothing has to be found."""
    world = FileToWorld(scans.survey.scale, scans.survey.up or "y")
    vertices = [scans.sequence(number, world).vertices(index) for number, index in scans.spread_frames(_FRAMES)]
    clothes_m = scans.options.clothes_m
    follower = prepare_follower(fitter.whole, fitter.faces, fitter.faces, vertices, [], clothes_m=clothes_m)
    if scans.survey.up is None:
        poses = follower.follow(vertices.__getitem__, len(vertices)).poses
        world = replace(world, up=up_axis(Rotation.from_rotvec(poses[:, 0])))
        log.info("up axis %s: the body stands along it (data.up=y or z sets it)", world.up)
    return FitMade(follower.betas, world, settings, scans.options.body.size)


def _up_by_fits(scans: SubjectScans, fitter: Fitter) -> str:
    """Return the up axis with which the body fits better to some frames."""
    cost = {}
    for up in AXES:
        seen = _find(scans, FileToWorld(scans.survey.scale, up), _FRAMES_OF_UP)
        cost[up] = float(np.mean([one.found.agreement.misfit for one in seen]))
    chosen = min(cost, key=lambda up: cost[up])
    log.info("up axis %s: the body fits better than with the other one (data.up=y or z sets it)", chosen)
    return chosen


def _find(scans: SubjectScans, world: FileToWorld, count: int) -> list[_Seen]:
    """Return frames spread over all sequences, with the body found in each."""
    chosen = scans.spread_frames(count)
    points = [scans.sequence(number, world)[index] for number, index in chosen]
    found = _found_in(scans, points)
    return [_Seen(*place, scan, one) for place, scan, one in zip(chosen, points, found, strict=True)]


def _found_in(scans: SubjectScans, points: Sequence[ScanPoints]) -> list[Found]:
    """Return the body found in each scan, by several processes."""
    options = scans.options
    workers = max(1, min(options.workers, len(points)))
    parts = [points[start::workers] for start in range(workers)]
    found: list[list[Found]] = [[] for _ in parts]
    results = run_in_processes(find_single_frames, ((options.body, options.clothes_m, part) for part in parts), workers)
    try:
        for task, one in progress(results, total=len(points), desc="looking for the body", unit="frames"):
            found[task].append(one)
    finally:
        results.close()
    return [found[number % workers][number // workers] for number in range(len(points))]


def _check_others(subject: str, scans: SubjectScans, world: FileToWorld) -> None:
    """Raise UserError if a part beside the subject is a person too."""
    parts = [
        ScanPoints.sampled(world.points(points), normals @ world.turn.T, scans.options.points_per_frame)
        for points, normals in scans.survey.others[:_OTHERS]
    ]
    for found in _found_in(scans, parts) if parts else []:
        if found.agreement.misfit <= _MOST_MISFIT:
            raise UserError(f"the scans of {subject} show several persons; keep one of them in each scan")


def _compare_sequences(scans: SubjectScans, surface: BodySurface, seen: Sequence[_Seen]) -> None:
    """Warn if the bodies of two sequences differ so much that they are hardly of one person."""
    by_sequence: dict[int, list[Array]] = {}
    for one in seen:
        by_sequence.setdefault(one.sequence, []).append(one.found.state.betas)
    middles = {number: surface.points_by_beta @ np.median(shapes, 0) for number, shapes in by_sequence.items()}
    for number, shape in middles.items():
        others = [other for key, other in middles.items() if key != number]
        if others and (apart := _apart(shape, np.mean(others, 0))) > _SHAPES_APART_M:
            log.warning(
                "warning: the body of sequence %s differs by %.0f mm from that of the others; if these are different persons, "
                "give each a subject folder of its own",
                scans.names[number], 1000 * apart,
            )  # fmt: skip


def _apart(one: Array, other: Array) -> float:
    """Return the mean distance between the offsets [K, 3] of two shapes without the shift between them, metres."""
    away = one - other
    return float(np.linalg.norm(away - away.mean(0), axis=1).mean())
