"""The training loop: progress, validation, checkpoints, interruption and resumption."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from snarfcli.files import write_tensors
from snarfcli.interrupts import interrupts_noted
from snarfcli.progress import progress_bar
from snarfcli.training.numbers import History
from snarfcli.training.schedule import is_due, learning_rate
from snarfcli.training.trainer import Trainer

__all__ = ["train"]

log = logging.getLogger(__name__)
_REPORT_EVERY_S = 15.0
_SHOW_EVERY_S = 0.5  # on a terminal; reading the losses waits for a GPU
_LAST_STEPS = 50  # reported losses are means over this number of steps
_SCALARS_EVERY = 20  # steps


def train(trainer: Trainer, folder: Path, *, on_scalars: Callable[[int, dict[str, float]], None]) -> dict[str, Any]:
    """Run all remaining steps, with checkpoints in `folder`.

    Ctrl-C, SIGTERM and SIGHUP finish the running step, write a checkpoint and raise KeyboardInterrupt; a second Ctrl-C stops
    at once.

    Args:
        trainer: new or restored.
        folder: the run folder; its `checkpoint.pt` is replaced every `checkpoint_every` steps.
        on_scalars: called with the step and named numbers, for TensorBoard.

    Returns:
        The last validation, the speed of this part of the run, and the time per step and the processor time of all parts.
    """
    config = trainer.config
    first_step, seconds_before, processor_before = trainer.step, trainer.seconds, trainer.processor_s
    recent, written = History(_LAST_STEPS), first_step
    validation: dict[str, float] = {}
    points_per_step = config.poses_per_step * (config.uniform_points + config.surface_points)
    paused = processor_paused = 0.0
    if is_due(first_step, config.validate_every) and not any(one["step"] == first_step for one in trainer.validations):
        trainer.validate()  # the run was interrupted between a checkpoint and this validation
    start, processor_start, shown_at = time.monotonic(), time.process_time(), 0.0

    bar = progress_bar(total=config.steps, done=first_step, desc="train", unit="step")
    with closing(trainer.batches), interrupts_noted(_tell_of_interrupt) as interrupt, bar as shown:
        while trainer.step < config.steps:
            numbers = trainer.advance()
            step, last = trainer.step, trainer.step == config.steps
            recent.add(step, numbers)
            seconds = time.monotonic() - start - paused
            trainer.seconds = seconds_before + seconds
            if processor_before is not None:
                trainer.processor_s = processor_before + time.process_time() - processor_start - processor_paused
            speed = (step - first_step) / max(seconds, 1e-9)
            if step % _LAST_STEPS == 0 or last:
                written = _write_scalars(on_scalars, recent, written, trainer, speed * points_per_step)
            validates = step % config.validate_every == 0 or last
            if interrupt or validates or step % config.checkpoint_every == 0:
                write_tensors(folder / "checkpoint.pt", trainer.state())
            if interrupt:
                raise interrupt.as_error()
            if validates:
                since, processor_since = time.monotonic(), time.process_time()
                with interrupt.at_once():
                    validation = trainer.validate()
                on_scalars(step, {f"validation_{name}": value for name, value in validation.items()})
                paused += time.monotonic() - since
                processor_paused += time.process_time() - processor_since
            if shown is not None:
                shown.update(step - shown.n)
            unseen = seconds + paused - shown_at
            if unseen >= (_REPORT_EVERY_S if shown is None else _SHOW_EVERY_S) or last:
                shown_at = seconds + paused
                line = _line(recent, validation, speed * points_per_step)
                if shown is not None:
                    shown.set_postfix_str(line, refresh=False)
                else:
                    log.info("step %d of %d, %s, %.0f s left", step, config.steps, line, (config.steps - step) / speed)
        if interrupt:  # after the last step: the checkpoint has it
            raise interrupt.as_error()
    seconds = time.monotonic() - start - paused
    steps = trainer.step - first_step
    validation = validation or trainer.validate()  # a run interrupted after its last step has none yet
    return {
        "validation": validation,
        "steps_this_run": steps,
        "seconds_this_run": round(seconds, 2),
        "validation_seconds": round(paused, 2),
        "seconds_per_step": round(trainer.seconds / trainer.step, 4) if trainer.step else None,
        "processor_s": None if trainer.processor_s is None else round(trainer.processor_s, 2),
        "points_per_second": round(points_per_step * steps / seconds) if steps else None,
        "inside_without_correspondence": recent.means().get("inside_without_correspondence", 0.0),
    }


def _write_scalars(
    on_scalars: Callable[[int, dict[str, float]], None], recent: History, written: int, trainer: Trainer, points: float
) -> int:
    """Pass on the numbers of every 20th step after `written`, and of the last; return the last step that was passed on."""
    for step, numbers in recent.since(written + 1):
        if step % _SCALARS_EVERY == 0 or step == trainer.config.steps:
            rates = {"learning_rate": learning_rate(trainer.config, step), "points_per_second": points}
            on_scalars(step, dict(numbers) | rates)
            written = step
    return written


def _line(recent: History, validation: dict[str, float], points_per_second: float) -> str:
    """Return losses, speed and validation as one short line."""
    means = recent.means()
    hidden = ("total", "inside_without_correspondence", "correspondences_per_point")
    losses = ", ".join(f"{name.replace('_', ' ')} {mean:.4f}" for name, mean in means.items() if name not in hidden)
    lost = means["inside_without_correspondence"]
    parts = [f"loss {losses}", f"{points_per_second / 1000:.0f}k points/s"]
    if lost:
        parts.append(f"lost {100 * lost:.2f} % of inside points")
    if validation:
        parts.append(f"IoU bbox {100 * validation['iou_bbox']:.1f} surface {100 * validation['iou_surface']:.1f}")
    return ", ".join(parts)


def _tell_of_interrupt() -> None:
    log.info("interrupted: finishing the step and writing a checkpoint; press Ctrl-C again to stop at once")
