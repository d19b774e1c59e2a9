"""The plan of an experiment: its runs, and the commands that make each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from snarfcli.reproduce.experiments import Experiment

__all__ = ["EvaluationStage", "ExperimentOptions", "Job", "Plan", "SamplesStage", "unique_jobs"]


@dataclass(frozen=True)
class ExperimentOptions:
    """Options of `snarf reproduce` for one experiment; empty and None mean the defaults of the experiment."""

    subjects: tuple[str, ...] = ()
    seeds: tuple[int, ...] = (0,)
    training: str | None = None
    data: str | None = None
    systems: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()
    data_root: str = "data"
    output_root: str = "outputs"
    threads: int | None = None
    device: str = "auto"
    max_frames: int | None = None
    surface_frames: int = 0


@dataclass(frozen=True)
class SamplesStage:
    """Samples that a run needs, and the command that makes them."""

    folder: str
    """Folder of the samples."""
    arguments: tuple[str, ...]
    """Arguments of `snarf` that make them."""


@dataclass(frozen=True)
class EvaluationStage:
    """One evaluation of a run, and the command that makes it."""

    split: str
    """id or ood."""
    data: str
    """Data set of the samples."""
    data_root: str
    """Folder with the data set."""
    arguments: tuple[str, ...]
    """Arguments of `snarf`."""
    metrics: str
    """File that it writes."""
    settings: dict[str, Any]
    """Settings that the file must record; otherwise the evaluation is repeated."""


@dataclass(frozen=True)
class Job:
    """One run: one row of a table, one subject, one seed."""

    row: str
    """Key of the row."""
    label: str
    """Name of the row in the table."""
    data: str
    """Data set."""
    subject: str
    """Subject."""
    seed: int
    """Seed."""
    folder: str
    """Run folder."""
    samples: tuple[SamplesStage, ...]
    """Samples that must exist before the training."""
    train: tuple[str, ...]
    """Arguments of `snarf` that train it."""
    evaluations: tuple[EvaluationStage, ...]
    """Evaluations after the training."""
    digest: str
    """Hash of all settings that the avatar depends on."""
    kind: str
    """Hash of the settings without subject and seed: runs of one kind take about as long."""
    steps: int
    """Number of training steps."""
    hint_s: float
    """Rough processor time of its training in seconds, for estimates before anything is measured."""
    minutes: float | None = None
    """Budget of the training in minutes of one core, from which its number of steps follows; None: `train` has the number."""

    @property
    def name(self) -> str:
        """Name in progress lines."""
        return f"{self.label}, subject {self.subject}, seed {self.seed}"


@dataclass(frozen=True)
class Plan:
    """One experiment with its data, subjects, seeds and runs."""

    experiment: Experiment
    """The experiment, with the selected rows only."""
    data: str
    """Data set."""
    subjects: tuple[str, ...]
    """Subjects."""
    seeds: tuple[int, ...]
    """Seeds."""
    training: str
    """Training preset."""
    extra: tuple[str, ...]
    """Further settings of every training."""
    jobs: tuple[Job, ...]
    """Runs."""
    training_settings: dict[str, Any]
    """Settings of the preset after `extra`."""
    data_settings: dict[str, Any]
    """Settings of the data set."""


def unique_jobs(plans: Sequence[Plan]) -> list[Job]:
    """Return the jobs of several plans; jobs with the same run folder once."""
    unique: dict[str, Job] = {}
    for plan in plans:
        for job in plan.jobs:
            unique.setdefault(job.folder, job)
    return list(unique.values())
