"""Make the frames of an animation in order, in this process or on several."""

from __future__ import annotations

import contextlib
import logging
import signal
import sys
import time
from collections import deque
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from snarfcli.interrupts import interrupts_held_back
from snarfcli.meshing.mesh import Mesh
from snarfcli.parallel import Worker, choose_processes, end_workers
from snarfcli.progress import progress
from snarfcli.rendering.animation import Animation, FrameRecord
from snarfcli.rendering.panels import Screen

__all__ = ["frame_processes", "make_pictures"]

log = logging.getLogger(__name__)

_LEAST_FRAMES = 6  # per process: it starts in about three seconds, and fewer frames are faster without it
_BYTES_EACH = 2**30  # PyTorch, a paper-sized network, and the lattice and mesh of resolution 256
_BYTES_PER_CELL = 12  # of lattices, for the longest side cubed; a body fills a fifth of its cube or less

_Frame = tuple[FrameRecord, np.ndarray | None]
"""The record of a frame, and its picture if there is a screen."""


def frame_processes(wanted: int | None, frames: int, resolution: int, *, extract: bool = True, draw: bool = True) -> int:
    """Return the number of processes that make frames.

    Args:
        wanted: number in the settings; None chooses one per core, as far as memory and frames allow.
        frames: number of frames to make.
        resolution: cells along the longest side of the surface.
        extract: whether the processes extract surfaces; with a GPU only the main process does.
        draw: whether they draw pictures.
    """
    if not (extract or draw):
        return 1
    if wanted is not None:
        return min(wanted, frames)
    return choose_processes(frames, _BYTES_EACH + (_BYTES_PER_CELL * resolution**3 // 4 if extract else 0), _LEAST_FRAMES)


def make_pictures(
    animation: Animation, processes: int = 1, threads: int = 1, *, extracts_here: bool = False
) -> Iterator[np.ndarray | None]:
    """Extract and write the mesh of each frame, and yield its picture, or None without a screen.

    A frame without a surface gives a picture of the empty stage, so that the playback speed stays the same.

    Args:
        animation: gets the record of each frame.
        processes: number of processes that make frames at the same time; 1 works in this one.
        threads: tensor threads per process, if there are several.
        extracts_here: whether this process, which has the GPU, extracts all meshes, and the others only draw.

    Raises:
        UserError: a process ended early, for example because the system killed it when memory ran out.
    """
    count = len(animation.numbers)
    if processes == 1 or (extracts_here and animation.screen is None):
        frames = (animation.make(index) for index in range(count))
    elif extracts_here:
        frames = _draw_elsewhere(animation, min(processes, count))
    else:
        frames = _make_elsewhere(replace(animation, frames=[]), min(processes, count), threads)
    with contextlib.closing(frames):
        shown = progress(zip(range(count), frames, strict=True), total=count, desc=f"animate {animation.name}", unit="frames")
        for _, (frame, picture) in shown:
            _log_problems(frame)
            animation.frames.append(frame)
            yield picture


def _log_problems(frame: FrameRecord) -> None:
    if frame.problem:
        log.warning("frame %d: %s", frame.frame, frame.problem)
    for text in frame.missing:
        log.warning("frame %d, beside: %s", frame.frame, text)
    if frame.is_capped:
        log.warning("frame %d: the surface reaches the border of its box and was closed there", frame.frame)


def _make_elsewhere(animation: Animation, processes: int, threads: int) -> Generator[_Frame, None, None]:
    """Make the frames on several processes and yield them in order.

    Each of P processes makes every P-th frame. A process that is ahead waits until its frame is received, so at most two
    pictures per process are in memory.
    """
    workers: list[Worker] = []
    try:
        for first in range(processes):
            with interrupts_held_back():
                task = (animation, threads, range(first, len(animation.numbers), processes))
                workers.append(Worker(_make_frames, task, _fewer(processes)))
        for index in range(len(animation.numbers)):
            yield workers[index % processes].receive()[1]
    finally:
        end_workers(workers)


def _make_frames(animation: Animation, threads: int, indices: Sequence[int]) -> Iterator[_Frame]:
    """Make some frames in a worker process."""
    # The parent ends the process with SIGTERM. An orderly exit also deletes a half-written file.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    torch.set_num_threads(threads)
    try:
        for index in indices:
            yield animation.make(index)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # no file is half-written any more


def _draw_elsewhere(animation: Animation, processes: int) -> Generator[_Frame, None, None]:
    """Extract all meshes here, draw them on several processes, and yield the frames in order.

    A GPU extracts surfaces faster than one core draws them. Each process has at most one frame.
    """
    workers: list[Worker] = []
    waiting: deque[tuple[FrameRecord, Worker]] = deque()

    def oldest() -> _Frame:
        frame, worker = waiting.popleft()
        picture, seconds = worker.receive()[1]
        frame.rendering_s = round(seconds, 4)
        return frame, picture

    try:
        for _ in range(processes):
            with interrupts_held_back():
                workers.append(Worker(_draw_frames, (animation.screen,), _fewer(processes), has_requests=True))
        for index in range(len(animation.numbers)):
            frame, shown = animation.extract(index)
            if len(waiting) == processes:
                yield oldest()
            workers[index % processes].send((index, shown))
            waiting.append((frame, workers[index % processes]))
        while waiting:
            yield oldest()
    finally:
        end_workers(workers)


def _draw_frames(
    screen: Screen, requests: Iterator[tuple[int, Mapping[str, Mesh | None]]]
) -> Iterator[tuple[np.ndarray, float]]:
    """Draw frames in a worker process; yield each picture and the seconds that it took."""
    for index, shown in requests:
        start = time.perf_counter()
        picture = screen.draw(index, shown)
        yield picture, time.perf_counter() - start


def _fewer(processes: int) -> str:
    """Return the setting that asks for fewer processes."""
    return f"processes={max(1, processes // 2)}"
