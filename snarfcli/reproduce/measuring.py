"""Measure how long a run will take: a few steps of its training and a few frames of its evaluation, in a temporary folder.

The commands are those of the run, so that their start, the validations and the end of a training are measured, too.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snarfcli.errors import UserError
from snarfcli.evaluation.report import STORE_SPLITS
from snarfcli.files import read_json
from snarfcli.hydra_config.overrides import quote
from snarfcli.reproduce.durations import Duration, machine_name
from snarfcli.reproduce.plans import EvaluationStage, Job
from snarfcli.reproduce.results import look_up, read_metrics
from snarfcli.reproduce.running import Runner, processor_s_of_children, run_command
from snarfcli.runs import run_folder
from snarfcli.samples.layout import samples_folder
from snarfcli.texts import one_line

__all__ = ["Measurements"]

_TRAINING_S = 8.0  # of steps that are measured, by the hint of the row
_FEWEST_STEPS, _MOST_STEPS = 8, 60
_FRAMES = 4
# Only some of the frames that a run uses: seconds instead of a minute to sample a subject.
_SPARSE = 12
_GENERATED = ("builtin", "clothed", "stick2d")  # data sets without files


@dataclass(frozen=True)
class _Spent:
    """What a command has taken."""

    wall_s: float
    processor_s: float


class Measurements:
    """Measures runs in a temporary folder. Samples are those of the plan if they exist, else sparse ones in the folder.

    Args:
        folder: an empty folder.
        threads: number of threads of commands that do not name it.
        runner: runs the commands.
    """

    def __init__(self, folder: Path, threads: int, runner: Runner = run_command) -> None:
        self.folder, self.threads, self.runner = folder, threads, runner

    def measure(self, job: Job, data: Mapping[str, Any]) -> Duration:
        """Return how long a run will take.

        Args:
            job: the run.
            data: settings of its data set.

        Raises:
            UserError: a command failed; the message has its reason.
            JobStopped: interrupted.
        """
        root, share = self._samples(job, data)
        steps = _steps_to_measure(job)
        where = {"data_root": quote(root), "output_root": quote(str(self.folder / "outputs")), "run": job.row}
        where["threads"] = _value(job.train, "threads") or str(self.threads)
        periods = dict.fromkeys(("training.validate_every", "training.checkpoint_every"), max(1, steps // 2))
        train = self._run(_with(job.train, {**where, "training.steps": steps, **periods}))
        content = read_metrics(self._output(job) / "metrics.json")
        evaluation = self._evaluation(job, root)
        chosen = {"max_frames": _FRAMES, "surface_frames": min(1, evaluation.settings["surface_frames"])}
        spent = self._run(_with(evaluation.arguments, {**where, **chosen}))
        (evaluated,) = self._output(job).glob("eval_*/metrics.json")
        measured = read_metrics(evaluated).content
        wall_s, count = look_up(measured, ("timings", "wall_s")) or 0.0, look_up(measured, ("frames",)) or _FRAMES
        train_s, train_processor_s = _whole_training(job, content.content, train)
        start_s = max(0.0, spent.wall_s - wall_s)
        frames = [_frames(one, job, root, share) for one in job.evaluations]
        evaluations_s = len(frames) * start_s + sum(frames) * wall_s / (count + 1)  # the first one is done twice
        gpu, threads = content.machine.get("gpu"), content.machine.get("threads")
        return Duration(
            round(train_s, 1), round(evaluations_s, 1), round(train_processor_s, 1),
            round(evaluations_s * _per_wall(spent), 1),
            threads if type(threads) is int else 1, machine_name(content.machine), gpu if isinstance(gpu, str) else "",
        )  # fmt: skip

    def _samples(self, job: Job, data: Mapping[str, Any]) -> tuple[str, int]:
        """Return the folder with samples of the subject, and how many frames of a run one of their frames stands for."""
        stage, root = job.samples[0], job.evaluations[0].data_root
        if (Path(stage.folder) / "manifest.json").is_file():
            return root, 1
        sparse = str(self.folder / "data")
        if not (samples_folder(sparse, job.data, job.subject) / "manifest.json").is_file():
            steps = {
                f"data.{name}": _SPARSE * data.get(name, 1) for name in ("frame_step", "test_frame_step", "ood_frame_step")
            }
            files = {} if job.data in _GENERATED else {"data.folder": quote(root), "body": quote(root)}
            self._run(_with(stage.arguments, {"data_root": quote(sparse), **steps, **files}))
        return sparse, _SPARSE

    def _evaluation(self, job: Job, root: str) -> EvaluationStage:
        """Return the evaluation to measure: one whose data set is that of the training, with frames if there are any."""
        known = [one for one in job.evaluations if one.data == job.data]
        with_frames = [one for one in known if _count(samples_folder(root, job.data, job.subject), one.split)]
        return (with_frames or known)[0]

    def _output(self, job: Job) -> Path:
        return run_folder(str(self.folder / "outputs"), job.data, job.subject, job.row)

    def _run(self, arguments: Sequence[str]) -> _Spent:
        log = self.folder / "measure.log"
        start, processor_start = time.monotonic(), processor_s_of_children()
        code = self.runner(arguments, log, lambda: False)
        spent = _Spent(time.monotonic() - start, processor_s_of_children() - processor_start)
        if code != 0:
            lines = log.read_text(errors="replace").splitlines() if log.is_file() else []
            raise UserError(one_line(lines[-1] if lines else f"exit code {code}", 300))
        return spent


def _steps_to_measure(job: Job) -> int:
    """Return a number of steps that takes some seconds by the hint of the row."""
    steps = int(_TRAINING_S * job.steps / max(job.hint_s, 1e-3))
    return min(job.steps, max(_FEWEST_STEPS, min(_MOST_STEPS, steps)))


def _whole_training(job: Job, metrics: dict[str, Any], spent: _Spent) -> tuple[float, float]:
    """Return the duration and the processor time of a whole training from a part of it.

    Args:
        job: the run.
        metrics: what the part has written.
        spent: what its command took.

    Raises:
        UserError: the metrics have no times.
    """
    steps, mean_s = look_up(metrics, ("steps",)), look_up(metrics, ("timings", "seconds_per_step"))
    validations_s = look_up(metrics, ("timings", "validation_seconds")) or 0.0
    if not steps or mean_s is None:
        raise UserError("the training has written no times")
    measured = metrics.get("validations") or []
    step_s = mean_s
    if len(measured) > 1:  # without the first steps, which also load libraries and allocate memory
        first, last = measured[0], measured[-1]
        step_s = (last["seconds"] - first["seconds"]) / max(1, last["step"] - first["step"])
    validation_s = validations_s / max(1, len(measured))
    validate_every = int(_value(job.train, "training.validate_every") or job.steps)
    other_s = max(0.0, spent.wall_s - steps * mean_s - validations_s)
    other_s += validation_s * math.ceil(job.steps / validate_every)
    processor_s = look_up(metrics, ("timings", "processor_s"))
    per_wall = _per_wall(spent) if processor_s is None else processor_s / max(steps * mean_s, 1e-3)
    return other_s + job.steps * step_s, other_s * _per_wall(spent) + job.steps * step_s * per_wall


def _per_wall(spent: _Spent) -> float:
    """Return the processor time of a command per second; 1 where the system does not tell it."""
    return spent.processor_s / spent.wall_s if spent.processor_s and spent.wall_s else 1.0


def _frames(evaluation: EvaluationStage, job: Job, root: str, share: int) -> int:
    """Return the number of frames of an evaluation; as many as are held out where samples of another data set are not there."""
    count = _count(samples_folder(evaluation.data_root, evaluation.data, job.subject), evaluation.split)
    if not count:
        split = evaluation.split if evaluation.data == job.data else "id"
        count = share * _count(samples_folder(root, job.data, job.subject), split)
    most = evaluation.settings["max_frames"]
    return count if most is None else min(most, count)


def _count(samples: Path, split: str) -> int:
    """Return the number of frames of a split in samples; 0 if they are not there."""
    try:
        count = look_up(read_json(samples / "manifest.json"), ("frames", STORE_SPLITS[split]))
    except UserError:
        return 0
    return 0 if count is None else int(count)


def _with(arguments: Sequence[str], settings: Mapping[str, object]) -> list[str]:
    """Return the arguments of a command with some settings replaced or added."""
    kept = [argument for argument in arguments if argument.partition("=")[0] not in settings]
    return [*kept, *(f"{name}={value}" for name, value in settings.items())]


def _value(arguments: Sequence[str], name: str) -> str | None:
    return next((argument.partition("=")[2] for argument in arguments if argument.startswith(f"{name}=")), None)
