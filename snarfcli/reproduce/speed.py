"""Trainings with a budget of minutes: short trainings measure the time of a step, from which the number of steps follows."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from snarfcli.descriptions import DescriptionError, read_described
from snarfcli.errors import UserError
from snarfcli.files import read_json
from snarfcli.hydra_config.overrides import quote
from snarfcli.reproduce.plans import Job

__all__ = ["count_steps", "timed_arguments"]

_FOLDER = "speed"  # of the short trainings, in the run folder
_SHARE = 0.1  # of the budget that the steps of the second short training may take
_VALIDATIONS, _VALIDATION_FRAMES = 12, 8  # of the training, for its curve; rows with other presets have the same frames


@dataclass(frozen=True)
class _Probe:
    """Length of a short training."""

    uncounted: int
    """Number of its first steps, which take longer: memory is allocated and code is loaded."""
    steps: int
    """Number of all its steps, a multiple of `uncounted`."""


_FIRST = _Probe(4, 8)  # ten seconds of the slowest row; every 4th step of the presets has the loss for made-up poses
# 100 steps are like any 100 of the presets: every 4th has the loss for made-up poses, and one updates the cells. In
# training=quick, the steps 21 to 120 took 0.047 s of one core each, and so did the steps 301 to 1,200.
_LONGEST = _Probe(20, 120)


@dataclass(frozen=True)
class _Validation:
    """Validation of the short training."""

    step: int
    """Number of steps before it."""
    seconds: float
    """Time that they took."""
    processor_s: float | None = None
    """Processor time that they took."""


@dataclass(frozen=True)
class _Timings:
    """Times of all steps of the short training."""

    seconds_per_step: float
    """Mean time of a step."""
    processor_s: float | None = None
    """Processor time of all steps."""


@dataclass(frozen=True)
class _Metrics:
    """Metrics of the short training."""

    steps: int
    """Number of its steps."""
    timings: _Timings
    """Times of all steps."""
    validations: list[_Validation] = field(default_factory=list)
    """Its validations; none for data without held-back frames."""
    machine: dict[str, Any] = field(default_factory=dict)
    """The machine."""


def count_steps(job: Job, run: Callable[[Sequence[str]], bool]) -> int | None:
    """Return how many steps fit into the minutes of a job, at least 1; None if a short training has failed.

    A first short training tells how many steps fit into a tenth of the minutes; a second one of so many steps, at most 120,
    measures them. The second is left out if it would not be longer. The processor time counts, which other work on the machine
    hardly changes; on a GPU the wall time.

    Args:
        job: a job with a budget.
        run: runs `snarf` with arguments and returns whether it has succeeded.

    Raises:
        UserError: the metrics of a short training are missing or damaged.
    """
    assert job.minutes is not None
    budget_s = 60 * job.minutes
    step_s = _measure(job, _FIRST, run)
    if step_s is None:
        return None
    second = _probe_of(_SHARE * budget_s / step_s)
    if second.steps > _FIRST.steps:
        step_s = _measure(job, second, run)
    return None if step_s is None else max(1, round(budget_s / step_s))


def timed_arguments(job: Job, steps: int) -> tuple[str, ...]:
    """Return the arguments of `snarf` for the training of a job with a budget, of which the number of steps is known."""
    given = {argument.partition("=")[0] for argument in job.train}
    curve = {
        "training.validate_every": max(1, steps // _VALIDATIONS),
        "training.validation_frames": _VALIDATION_FRAMES,
    }
    of_curve = (f"{name}={value}" for name, value in curve.items() if name not in given)
    return (*job.train, f"training.steps={steps}", *of_curve)


def _probe_of(steps: float) -> _Probe:
    """Return the longest short training of at most a number of steps."""
    parts = _LONGEST.steps // _LONGEST.uncounted
    uncounted = min(_LONGEST.uncounted, int(steps / parts))
    return _Probe(uncounted, parts * uncounted)


def _measure(job: Job, probe: _Probe, run: Callable[[Sequence[str]], bool]) -> float | None:
    """Run a short training and return the time of a step in seconds; None if it has failed."""
    folder = Path(job.folder) / _FOLDER
    arguments = (
        *job.train, f"training.steps={probe.steps}", f"training.validate_every={probe.uncounted}",
        "training.validation_frames=1", "training.validation_ood_frames=0", f"output_root={quote(str(folder))}",
    )  # fmt: skip
    shutil.rmtree(folder, ignore_errors=True)  # one that was killed, or that had another number of steps
    try:
        if not run(arguments):
            return None
        return _step_s(_read_metrics(folder / job.data / job.subject / Path(job.folder).name / "metrics.json"), probe)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _read_metrics(path: Path) -> _Metrics:
    """Return the metrics of a short training.

    Raises:
        UserError: they are missing or damaged.
    """
    try:
        return read_described(_Metrics, read_json(path, "metrics"), "metrics", ignore_unknown=True)
    except DescriptionError as error:
        raise UserError(f"the time of a step is unknown: {path} is damaged ({error}); run the same command again") from None


def _step_s(metrics: _Metrics, probe: _Probe) -> float:
    """Return the time of a step in seconds: of those after the first ones, or of all if nothing was measured in between."""
    on_gpu = "gpu" in metrics.machine
    times = {one.step: one.seconds if on_gpu or one.processor_s is None else one.processor_s for one in metrics.validations}
    if probe.uncounted in times and probe.steps in times:
        step_s = (times[probe.steps] - times[probe.uncounted]) / (probe.steps - probe.uncounted)
    elif on_gpu or metrics.timings.processor_s is None:
        step_s = metrics.timings.seconds_per_step
    else:
        step_s = metrics.timings.processor_s / max(metrics.steps, 1)
    return max(step_s, 1e-6)
