"""Trainings with a budget of minutes: a short training measures the time of a step, from which the number of steps follows."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from snarfcli.descriptions import DescriptionError, read_described
from snarfcli.errors import UserError
from snarfcli.files import read_json
from snarfcli.hydra_config.overrides import quote
from snarfcli.reproduce.plans import Job

__all__ = ["SPEED_FOLDER", "clear_speed", "measured_steps", "speed_arguments", "timed_arguments"]

SPEED_FOLDER = "speed"
"""Name of the folder of the short training, in the run folder."""

# The first steps take longer: memory is allocated and code is loaded. The 100 steps after them are like any 100 of the presets:
# every 4th has the loss for made-up poses, and one updates the cells. In training=quick, the steps 21 to 120 took 0.047 s of
# one core each, and so did the steps 301 to 1,200.
_UNCOUNTED, _STEPS = 20, 120
_VALIDATIONS, _VALIDATION_FRAMES = 12, 8  # of the training, for its curve; rows with other presets have the same frames


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


def speed_arguments(job: Job) -> tuple[str, ...]:
    """Return the arguments of `snarf` for the short training: the first steps of the training of a job, in another folder."""
    return (
        *job.train, f"training.steps={_STEPS}", f"training.validate_every={_UNCOUNTED}", "training.validation_frames=1",
        "training.validation_ood_frames=0", f"output_root={quote(str(Path(job.folder) / SPEED_FOLDER))}",
    )  # fmt: skip


def clear_speed(job: Job) -> None:
    """Delete the short training of a job, if there is one."""
    shutil.rmtree(Path(job.folder) / SPEED_FOLDER, ignore_errors=True)


def measured_steps(job: Job) -> int:
    """Return how many steps fit into the minutes of a job, from the metrics of its short training; at least 1.

    Its processor time counts, which other work on the machine hardly changes; on a GPU the wall time.

    Raises:
        UserError: the metrics are missing or damaged.
    """
    assert job.minutes is not None
    path = Path(job.folder) / SPEED_FOLDER / job.data / job.subject / Path(job.folder).name / "metrics.json"
    try:
        step_s = _step_s(read_described(_Metrics, read_json(path, "metrics"), "metrics", ignore_unknown=True))
    except DescriptionError as error:
        raise UserError(f"cannot measure the time of a step, since {path} is damaged ({error})") from None
    return max(1, round(60 * job.minutes / step_s))


def timed_arguments(job: Job, steps: int) -> tuple[str, ...]:
    """Return the arguments of `snarf` for the training of a job with a budget, of which the number of steps is known."""
    given = {argument.partition("=")[0] for argument in job.train}
    curve = {
        "training.validate_every": max(1, steps // _VALIDATIONS),
        "training.validation_frames": _VALIDATION_FRAMES,
    }
    of_curve = (f"{name}={value}" for name, value in curve.items() if name not in given)
    return (*job.train, f"training.steps={steps}", *of_curve)


def _step_s(metrics: _Metrics) -> float:
    """Return the time of a step in seconds: of those after the first ones, or of all if nothing was measured in between."""
    on_gpu = "gpu" in metrics.machine
    times = {one.step: one.seconds if on_gpu or one.processor_s is None else one.processor_s for one in metrics.validations}
    if _UNCOUNTED in times and _STEPS in times:
        step_s = (times[_STEPS] - times[_UNCOUNTED]) / (_STEPS - _UNCOUNTED)
    elif on_gpu or metrics.timings.processor_s is None:
        step_s = metrics.timings.seconds_per_step
    else:
        step_s = metrics.timings.processor_s / max(metrics.steps, 1)
    return max(step_s, 1e-6)
