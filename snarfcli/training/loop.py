"""The training loop: progress, validation, checkpoints, interruption and resumption."""

from __future__ import annotations

import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from snarfcli.files import write_tensors
from snarfcli.training.trainer import Trainer

__all__ = ["train"]

log = logging.getLogger(__name__)
_REPORT_EVERY_S = 15.0
_LAST_STEPS = 50  # reported losses are means over this number of steps


def train(trainer: Trainer, folder: Path, *, on_scalars: Callable[[int, dict[str, float]], None]) -> dict[str, Any]:
    """Run all remaining steps, with checkpoints in `folder`.

    Ctrl-C finishes the running step, writes a checkpoint and raises KeyboardInterrupt; a second one stops at once.

    Args:
        trainer: new or restored.
        folder: the run folder; its `checkpoint.pt` is replaced every `checkpoint_every` steps.
        on_scalars: called with the step and named numbers, for TensorBoard.

    Returns:
        The last validation and the speed of this part of the run.
    """
    config = trainer.config
    first_step, start, reported = trainer.step, time.monotonic(), 0.0
    recent: list[dict[str, float]] = []
    validation: dict[str, float] = {}
    points_per_step = config.poses_per_step * (config.uniform_points + config.surface_points)
    paused = 0.0

    with closing(trainer.batches), _interrupt_between_steps() as interrupted, _bar(config.steps, first_step) as bar:
        while trainer.step < config.steps:
            recent = [*recent, trainer.advance()][-_LAST_STEPS:]
            step, last = trainer.step, trainer.step == config.steps
            seconds = time.monotonic() - start - paused
            speed = (step - first_step) / max(seconds, 1e-9)
            if step % 20 == 0 or last:
                on_scalars(step, recent[-1] | {"learning_rate": trainer.learning_rate()})
                on_scalars(step, {"points_per_second": speed * points_per_step})
            if step % config.validate_every == 0 or last:
                before = time.monotonic()
                validation = trainer.validate()
                on_scalars(step, {f"validation_{name}": value for name, value in validation.items()})
                paused += time.monotonic() - before
            if interrupted.is_set() or step % config.checkpoint_every == 0 or last:
                write_tensors(folder / "checkpoint.pt", trainer.state())
            if interrupted.is_set():
                raise KeyboardInterrupt
            line = _line(recent, validation, speed * points_per_step)
            if bar is not None:
                bar.update(1)
                bar.set_postfix_str(line, refresh=False)
            elif seconds + paused - reported >= _REPORT_EVERY_S or last:
                reported = seconds + paused
                remaining = (config.steps - step) / speed
                log.info("step %d of %d, %s, %.0f s left", step, config.steps, line, remaining)
    seconds = time.monotonic() - start - paused
    steps = trainer.step - first_step
    validation = validation or trainer.validate()  # a run interrupted after its last step has none yet
    return {
        "validation": validation,
        "steps_this_run": steps,
        "seconds_this_run": round(seconds, 2),
        "validation_seconds": round(paused, 2),
        "seconds_per_step": round(seconds / steps, 4) if steps else None,
        "points_per_second": round(points_per_step * steps / seconds) if steps else None,
        "inside_without_correspondence": _mean(recent, "inside_without_correspondence"),
    }


def _line(recent: list[dict[str, float]], validation: dict[str, float], points_per_second: float) -> str:
    """Return losses, speed and validation as one short line."""
    names = [n for n in recent[-1] if n not in ("total", "inside_without_correspondence", "correspondences_per_point")]
    losses = ", ".join(f"{name.replace('_', ' ')} {_mean(recent, name):.4f}" for name in names)
    lost = _mean(recent, "inside_without_correspondence")
    parts = [f"loss {losses}", f"{points_per_second / 1000:.0f}k points/s"]
    if lost:
        parts.append(f"lost {100 * lost:.2f} % of inside points")
    if validation:
        parts.append(f"IoU {100 * validation['iou_bbox']:.1f}/{100 * validation['iou_surface']:.1f}")
    return ", ".join(parts)


def _mean(recent: list[dict[str, float]], name: str) -> float:
    values = [numbers[name] for numbers in recent if name in numbers]
    return sum(values) / len(values) if values else 0.0


@contextmanager
def _bar(steps: int, first_step: int) -> Iterator[Any]:
    """Yield a progress bar on a terminal, else None."""
    if not sys.stderr.isatty():
        yield None
        return
    with tqdm(total=steps, initial=first_step, desc="train", unit="step", dynamic_ncols=True) as bar:
        yield bar


@contextmanager
def _interrupt_between_steps() -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C sets, so that the running step is finished; the second raises KeyboardInterrupt."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return

    def handle(number: int, frame: Any) -> None:
        if event.is_set():
            raise KeyboardInterrupt
        event.set()
        log.info("interrupted: finishing the step and writing a checkpoint; press Ctrl-C again to stop at once")

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, before)
