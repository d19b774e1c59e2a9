"""The parts of a fit that run in worker processes: single frames, and whole sequences."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from snarfcli.registration.body_surface import BodyState
from snarfcli.registration.same_topology import NoUsualFrames, fit_one_topology, is_own_topology
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.starts import Found
from snarfcli.registration.tracker import FittedSequence, fit_sequence
from snarfcli.scanned_subjects.fitter import BodyChoice, Fitter, load_fitter
from snarfcli.scanned_subjects.scans import ScanSequence

__all__ = ["SequenceTask", "find_single_frames", "fit_sequences", "is_in_order"]

Array = NDArray[np.float64]

_SHORT = 30  # frames; a shorter sequence is fitted faster by its points than by its vertices
_ANCHORS = 4  # frames that are found before vertices are attached to the body
_GOOD = 1.3  # times the misfit of the best of them
_MOST_TRUSTED = 0.5  # share of the frames; with fewer, the vertices are no fixed points of a body
_PAIRS = 6  # of frames that are compared to see whether a sequence is a motion
_COMPARED = 300  # points
_NEAR = 0.6  # distance of neighbouring frames to that of others, below which they are a motion
_NEAR_M = 0.02


@dataclass(frozen=True)
class SequenceTask:
    """One sequence to fit."""

    number: int
    """Of the sequence."""
    scans: ScanSequence
    """Its frames, without those that cannot be read."""
    ordered: str
    """Whether neighbouring frames show a motion: auto, true or false."""
    has_one_topology: bool
    """Whether all frames are meshes with the same faces."""


def find_single_frames(choice: BodyChoice, clothes_m: float, scans: Sequence[ScanPoints]) -> Iterator[Found]:
    """Yield the body in each scan, found from anywhere, with a shape of its own."""
    finder = load_fitter(choice).finder
    for scan in scans:
        yield finder.find(scan, clothes_m=clothes_m)


def fit_sequences(
    choice: BodyChoice, betas: Array, clothes_m: float, tasks: Sequence[SequenceTask]
) -> Iterator[tuple[int, int | tuple[FittedSequence, float]]]:
    """Fit sequences one after the other.

    Args:
        choice: the body.
        betas: [S], its shape.
        clothes_m: how far the body may be below the surface, metres.
        tasks: the sequences.

    Yields:
        The number of a sequence, and the number of a frame that is done or, at the end, the poses and the processor time.
    """
    fitter = load_fitter(choice)
    for task in tasks:
        started = time.process_time()
        for item in _told(partial(_fit_sequence, fitter, betas, clothes_m, task)):
            yield task.number, item if isinstance(item, int) else (item, time.process_time() - started)


def _fit_sequence(
    fitter: Fitter, betas: Array, clothes_m: float, task: SequenceTask, on_frame: Callable[[int], None]
) -> FittedSequence:
    """Fit one sequence: by its vertices where all frames have the same, otherwise by points on the surface."""
    told: set[int] = set()

    def tell(frame: int) -> None:  # once, also where the vertices were followed in vain
        if frame not in told:
            told.add(frame)
            on_frame(frame)

    if task.has_one_topology:
        fitted = _follow_vertices(fitter, betas, clothes_m, task.scans, tell)
        if fitted is not None:
            return fitted
    return fit_sequence(
        fitter.surface,
        task.scans,
        fitter.finder,
        fitter.prior,
        betas=betas,
        clothes_m=clothes_m,
        is_ordered=task.ordered == "true" or (task.ordered == "auto" and is_in_order(task.scans)),
        on_frame=tell,
    )


def _follow_vertices(
    fitter: Fitter, betas: Array, clothes_m: float, scans: ScanSequence, on_frame: Callable[[int], None]
) -> FittedSequence | None:
    """Fit a sequence whose frames have the same faces; None if it is too short, or if its vertices
    are not the same in most frames or do not stay on the body."""
    faces, anchors = scans.faces(), {}

    def refit(frame: int, near: Sequence[BodyState]) -> Found:
        return fitter.finder.find(scans[frame], betas=betas, clothes_m=clothes_m, near=near)

    if not is_own_topology(fitter.faces, len(scans.vertices(0)), faces):
        if len(scans) < _SHORT:
            return None
        for frame in np.linspace(0, len(scans) - 1, _ANCHORS).round().astype(int).tolist():
            anchors[frame] = refit(frame, ())
        best = min(found.agreement.misfit for found in anchors.values())
        anchors = {frame: found.state for frame, found in anchors.items() if found.agreement.misfit < _GOOD * best}
    try:
        fitted = fit_one_topology(
            fitter.whole,
            fitter.faces,
            faces,
            scans.vertices,
            len(scans),
            anchors,
            betas=betas,
            clothes_m=clothes_m,
            refit=refit,
            on_frame=on_frame,
        )
    except NoUsualFrames:
        return None
    return fitted if fitted.is_trusted.mean() > _MOST_TRUSTED else None


def is_in_order(scans: ScanSequence) -> bool:
    """Return whether neighbouring frames of a sequence are more alike than others, as in a motion."""
    if len(scans) < 3:
        return True
    draws = np.random.default_rng(0)
    first = np.unique(np.linspace(0, len(scans) - 2, _PAIRS).round().astype(int))
    near, far = [], []
    for number in first:
        scan, other = scans[int(number)], scans[int(draws.integers(len(scans)))]
        near.append(_apart(scan, scans[int(number) + 1]))
        far.append(_apart(scan, other))
    return bool(np.median(near) < max(_NEAR_M, _NEAR * np.median(far)))


def _apart(one: ScanPoints, other: ScanPoints) -> float:
    """Return the mean distance from points of one scan to the other, metres."""
    return float(KDTree(other.points).query(one.points[:_COMPARED])[0].mean())


def _told(function: Callable[[Callable[[int], None]], FittedSequence]) -> Iterator[int | FittedSequence]:
    """Call a function that reports numbers, in a thread; yield the numbers, then the result, or raise its exception."""
    said: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()

    def work() -> None:
        try:
            said.put(("result", function(lambda number: said.put(("number", number)))))
        except BaseException as error:
            said.put(("error", error))

    threading.Thread(target=work, daemon=True).start()
    while True:
        kind, item = said.get()
        if kind == "error":
            raise item
        yield item
        if kind == "result":
            return
