"""The parts of a fit that run in worker processes: single frames, and whole sequences."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from snarfcli.registration.fitter import BodyChoice, load_fitter
from snarfcli.registration.scan_points import ScanPoints
from snarfcli.registration.scans import ScanSequence
from snarfcli.registration.starts import Found
from snarfcli.registration.tracker import FittedSequence, fit_sequence

__all__ = ["SequenceTask", "find_single_frames", "fit_sequences", "is_in_order"]

Array = NDArray[np.float64]

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
        is_ordered = task.ordered == "true" or (task.ordered == "auto" and is_in_order(task.scans))

        def fit(on_frame: Callable[[int], None], task: SequenceTask = task, is_ordered: bool = is_ordered) -> FittedSequence:
            return fit_sequence(
                fitter.surface,
                task.scans,
                fitter.finder,
                fitter.prior,
                betas=betas,
                clothes_m=clothes_m,
                is_ordered=is_ordered,
                on_frame=on_frame,
            )

        for item in _told(fit):
            yield task.number, item if isinstance(item, int) else (item, time.process_time() - started)


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
