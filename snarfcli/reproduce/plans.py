"""From the choice of an experiment to the list of runs that it needs, each with the commands that make it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request, find_source
from snarfcli.errors import UserError, nearest
from snarfcli.hydra_config.overrides import quote
from snarfcli.hydra_config.schema import group_options
from snarfcli.reproduce.experiments import EXPERIMENTS, Experiment, Row
from snarfcli.runs import run_folder
from snarfcli.samples.store import samples_folder

__all__ = ["Choice", "Evaluation", "Job", "Plan", "Samples", "choose_experiments", "make_plan", "unique_jobs"]

# PosePrior's motion on the bodies of DFaust's subjects: what is out of distribution is another data set.
_OTHER_OOD_DATA = {"dfaust": "poseprior"}
_PARITY_FOLDER = "parity"
# Settings of a training that the plan gives, and what a user gives instead.
_OWN_SETTINGS = {
    "subject": "subjects=[...]", "seed": "seeds=[...]", "run": "no name: runs are named after their row", "data": "data=NAME",
    "training": "training=NAME", "data_root": "data_root=...", "output_root": "output_root=...", "device": "device=...",
    "threads": "threads=...", "resume": "nothing: runs are always resumed", "overwrite": "another output_root",
}  # fmt: skip


@dataclass(frozen=True)
class Choice:
    """What a user chooses for one experiment; empty and None stand for the experiment's own."""

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
class Samples:
    """Samples that a run needs."""

    folder: str
    """Where they are."""
    arguments: tuple[str, ...]
    """Of `snarf` to make them."""


@dataclass(frozen=True)
class Evaluation:
    """One evaluation of a run."""

    split: str
    """id or ood."""
    data: str
    """Data set of the samples."""
    data_root: str
    """Folder that they are in."""
    arguments: tuple[str, ...]
    """Of `snarf`."""
    metrics: str
    """The file that it writes."""
    settings: dict[str, Any]
    """Settings that the file must name, or else it is made again."""


@dataclass(frozen=True)
class Job:
    """One run: one row of a table, on one subject, from one seed."""

    row: str
    """Key of the row."""
    label: str
    """What the table calls the row."""
    data: str
    """Data set."""
    subject: str
    """Subject."""
    seed: int
    """Seed."""
    folder: str
    """The run's folder."""
    samples: tuple[Samples, ...]
    """What must be there before."""
    train: tuple[str, ...]
    """Arguments of `snarf` that train it."""
    evaluations: tuple[Evaluation, ...]
    """What is measured."""
    digest: str
    """Stands for all settings that the avatar depends on."""

    @property
    def name(self) -> str:
        """How progress lines call it."""
        return f"{self.label}, subject {self.subject}, seed {self.seed}"

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Job:
        """Return the job that `dataclasses.asdict` described."""
        samples = tuple(Samples(one["folder"], tuple(one["arguments"])) for one in content["samples"])
        evaluations = tuple(Evaluation(**{**one, "arguments": tuple(one["arguments"])}) for one in content["evaluations"])
        return cls(**{**content, "samples": samples, "train": tuple(content["train"]), "evaluations": evaluations})


@dataclass(frozen=True)
class Plan:
    """One experiment as it is going to be made."""

    experiment: Experiment
    """Which, with the chosen rows only."""
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
    """Its runs."""
    training_settings: dict[str, Any]
    """The preset's settings, those of `extra` applied."""


def choose_experiments(what: str | None, choice: Choice) -> list[tuple[Experiment, Choice]]:
    """Return the experiments that a name stands for, each with the part of the choice that concerns it.

    With `all`, data, subjects and training are those of the body's tables; the 2D stick has its own, and the clothed experiment
    runs on CAPE with the licensed data and on the built-in garment otherwise.

    Raises:
        UserError: there is no such experiment.
    """
    names = (*EXPERIMENTS, "all")
    if what not in names:
        came = "got none" if what is None else f"got '{what}'{nearest(what, names)}"
        raise UserError(f"wanted what to reproduce, one of {', '.join(names)}, {came}; such as: snarf reproduce table1")
    if what != "all":
        return [(EXPERIMENTS[what], choice)]
    chosen = []
    for experiment in EXPERIMENTS.values():
        known = tuple(row for row in choice.systems if row in {r.key for r in experiment.rows})
        if choice.systems and not known:
            continue
        part = replace(choice, systems=known)
        if experiment.name == "stick2d":
            part = replace(part, data=None, subjects=(), training=None)
        elif experiment.name == "clothed":
            licensed = choice.data is not None and choice.data != "builtin"
            # subjects of CAPE are other people than DFaust's
            part = replace(part, data="cape" if licensed else None, subjects=() if licensed else choice.subjects)
        chosen.append((experiment, part))
    if not chosen:
        raise UserError(_unknown_systems(choice.systems, [row for one in EXPERIMENTS.values() for row in one.rows]))
    return chosen


def make_plan(experiment: Experiment, choice: Choice, resolve: Callable[[Sequence[str]], dict[str, Any]]) -> Plan:
    """Return the runs of one experiment: seed by seed, subject by subject, row by row, so that a whole table comes early.

    Every setting is checked and every subject found before anything runs.

    Args:
        experiment: which.
        choice: what of it, and how.
        resolve: returns the configuration of `snarf train` under overrides, without what the avatar does not depend on; raises
            UserError where one does not fit.

    Raises:
        UserError: something chosen is unknown, or cannot be used.
    """
    data = choice.data or experiment.data[0]
    if data not in experiment.data:
        raise UserError(f"{experiment.name} is made on data={' or '.join(experiment.data)}, got '{data}'")
    training = choice.training or experiment.training
    presets = group_options("training")
    if training not in presets:
        raise UserError(f"there is no training={training}{nearest(training, presets)}; choose from {', '.join(presets)}")
    keys = [row.key for row in experiment.rows]
    unknown = [key for key in choice.systems if key not in keys]
    if unknown:
        raise UserError(_unknown_systems(unknown, experiment.rows))
    rows = [row for row in experiment.rows if not choice.systems or row.key in choice.systems]
    if len(set(choice.seeds)) != len(choice.seeds) or not choice.seeds or min(choice.seeds) < 0:
        raise UserError(f"seeds: wanted different whole numbers from 0, at least one, got {list(choice.seeds)}")
    common = (f"data={data}", f"training={training}")
    _check_extra(choice.extra)
    resolved = {}
    for row in rows:
        try:
            resolved[row.key] = resolve((*common, *row.settings(training), *choice.extra))
        except UserError as error:
            raise UserError(f"row {row.key}: {error}") from None
    subjects = choice.subjects or experiment.subjects.get(data, ())
    _check_subjects(experiment, data, subjects, choice, resolved[rows[0].key]["data"])
    jobs = tuple(
        _job(row, data, subject, seed, training, choice, resolved[row.key])
        for seed in choice.seeds
        for subject in subjects
        for row in rows
    )
    # what the preset says, not what one of the rows changes
    preset = resolve((*common, *choice.extra))
    chosen = replace(experiment, rows=tuple(rows))
    return Plan(chosen, data, tuple(subjects), choice.seeds, training, choice.extra, jobs, preset["training"])


def unique_jobs(plans: Sequence[Plan]) -> list[Job]:
    """Return the jobs of several experiments, those that they share once."""
    unique: dict[str, Job] = {}
    for plan in plans:
        for job in plan.jobs:
            unique.setdefault(job.folder, job)
    return list(unique.values())


def _job(row: Row, data: str, subject: str, seed: int, training: str, choice: Choice, resolved: dict[str, Any]) -> Job:
    # The names of runs differ wherever their settings do, so that no table mixes them.
    name = f"{row.key}-{training}-s{seed}" + (f"-{_digest(list(choice.extra))[:6]}" if choice.extra else "")
    folder = run_folder(choice.output_root, data, subject, name)
    root = choice.data_root
    train_root = root if row.inside_test == "winding" else str(Path(root) / _PARITY_FOLDER)
    ood_data = _OTHER_OOD_DATA.get(data, data)
    samples = {(data, root): _samples(data, subject, root, ())}
    if ood_data != data:
        samples[ood_data, root] = _samples(ood_data, subject, root, ())
    if train_root != root:
        samples[data, train_root] = _samples(data, subject, train_root, _elsewhere(data, root, row.inside_test))
    machine = (f"device={choice.device}", *((f"threads={choice.threads}",) if choice.threads else ()))
    where = (_text("output_root", choice.output_root), f"run={name}")
    train = (
        "train", f"subject={quote(subject)}", f"data={data}", f"training={training}", *row.settings(training), *choice.extra,
        f"seed={seed}", _text("data_root", train_root), *where, *machine, "resume=true",
    )  # fmt: skip
    settings: dict[str, Any] = {"max_frames": choice.max_frames, "surface_frames": choice.surface_frames}
    part = "_part" if choice.max_frames is not None else ""
    evaluations = []
    for split, set_name in (("id", data), ("ood", ood_data)):
        other = f"_{set_name}" if set_name != data else ""
        arguments = (
            "eval", f"subject={quote(subject)}", f"data={set_name}", f"split={split}", _text("data_root", root), *where,
            *(f"{key}={'null' if value is None else value}" for key, value in settings.items()), "figure=false", *machine,
        )  # fmt: skip
        metrics = folder / f"eval_{split}{other}{part}" / "metrics.json"
        evaluations.append(Evaluation(split, set_name, root, arguments, str(metrics), settings))
    digest = _digest([resolved, seed, data, subject, row.inside_test])
    return Job(row.key, row.label, data, subject, seed, str(folder), tuple(samples.values()), train, tuple(evaluations), digest)


def _samples(data: str, subject: str, root: str, more: tuple[str, ...]) -> Samples:
    arguments = ("preprocess", f"subject={quote(subject)}", f"data={data}", _text("data_root", root), *more)
    return Samples(str(samples_folder(root, data, subject)), arguments)


def _elsewhere(data: str, root: str, inside_test: str) -> tuple[str, ...]:
    """Return the settings for samples under another root than the one below which the files of the data set lie."""
    files = () if data == "builtin" else (_text("data.folder", root), _text("body", root))
    return (f"inside_test={inside_test}", *files)


def _check_extra(extra: Sequence[str]) -> None:
    """Refuse further settings that the plan itself gives."""
    for override in extra:
        name = override.partition("=")[0].lstrip("+")
        if name in _OWN_SETTINGS:
            raise UserError(f"extra: {name} is set by reproduce itself; give {_OWN_SETTINGS[name]}")


def _check_subjects(experiment: Experiment, data: str, subjects: Sequence[str], choice: Choice, config: dict[str, Any]) -> None:
    """Refuse subjects that have neither samples nor meshes to make them from."""
    request = Request(DataConfig(**config), Path(choice.data_root))
    missing = [one for one in subjects if not (samples_folder(choice.data_root, data, one) / "manifest.json").exists()]
    if subjects and not missing:
        return
    there = tuple(find_source(data).subjects(request))
    if not subjects:
        raise UserError(f"{experiment.name} on data={data} needs subjects=[...]; there is {', '.join(there) or 'none'}")
    for subject in missing:
        if subject not in there:
            raise UserError(f"data={data} has no subject '{subject}'{nearest(subject, there)}; there is {', '.join(there)}")


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _text(name: str, value: str) -> str:
    return f"{name}={quote(value)}"


def _unknown_systems(keys: Sequence[str], rows: Sequence[Row]) -> str:
    known = list(dict.fromkeys(row.key for row in rows))
    return f"systems: there is no row '{keys[0]}'{nearest(keys[0], known)}; choose from {', '.join(known)}"
