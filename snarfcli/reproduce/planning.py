"""From the options of `snarf reproduce` to the plan of each experiment."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from snarfcli.checks import alternatives, check_choice
from snarfcli.datasets.registry import find_dataset
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.errors import UserError, nearest
from snarfcli.hydra_config.overrides import quote
from snarfcli.hydra_config.schema import group_options
from snarfcli.reproduce.experiments import EXPERIMENTS, Experiment, Row
from snarfcli.reproduce.plans import EvaluationStage, ExperimentOptions, Job, Plan, SamplesStage
from snarfcli.runs import run_folder
from snarfcli.samples.layout import samples_folder

__all__ = ["choose_experiments", "make_plan"]

log = logging.getLogger(__name__)

# The out-of-distribution poses of DFaust's subjects are another data set: PosePrior's motion on their bodies.
_OTHER_OOD_DATA = {"dfaust": "poseprior"}
_PARITY_FOLDER = "parity"
_STEPS = "training.steps"
_STEPS_OF_A_COST = 1200  # of training=quick, for which `Row.cost` is
# For the curves of a training: its number of validations, and of frames out of distribution in each.
_VALIDATIONS = 6
_VALIDATION_OOD_FRAMES = 8
# Settings of a training that the plan sets, and the setting of `snarf reproduce` to give instead.
_OWN_SETTINGS = {
    "subject": "subjects=[...]", "seed": "seeds=[...]", "run": "no name: runs are named after their row", "data": "data=NAME",
    "training": "training=NAME", "data_root": "data_root=...", "output_root": "output_root=...", "device": "device=...",
    "threads": "threads=...", "resume": "nothing: runs are always resumed", "overwrite": "another output_root",
}  # fmt: skip

Resolve = Callable[[Sequence[str]], dict[str, Any]]
"""Returns the configuration of `snarf train` for overrides, without the settings that do not change the avatar.

Raises UserError for an override that does not fit."""


def choose_experiments(what: str | None, options: ExperimentOptions) -> list[tuple[Experiment, ExperimentOptions]]:
    """Return the experiments that a name stands for, each with the options that apply to it.

    With `all`, data, subjects and training are options of the tables of bodies. The 2D stick keeps its own. The clothed
    experiment uses CAPE if a licensed data set is given, and the built-in garment otherwise. Rows with a budget of minutes are
    left out if the number of steps is given.

    Raises:
        UserError: there is no such experiment, or no experiment has one of the systems.
    """
    names = (*EXPERIMENTS, "all")
    if what is None:
        raise UserError(f"what: wanted {alternatives(names)}, got none; give it, such as: snarf reproduce table1")
    check_choice("what", what, names)
    if what != "all":
        return [(EXPERIMENTS[what], options)]
    chosen = []
    for experiment in EXPERIMENTS.values():
        known = tuple(row for row in options.systems if row in {r.key for r in experiment.rows})
        is_timed = any(row.minutes is not None for row in experiment.rows)
        if is_timed and _sets_steps(options.extra) and not known:
            log.info("%s is left out, since its minutes and %s exclude each other", experiment.name, _STEPS)
            continue
        if options.systems and not known:
            continue
        part = replace(options, systems=known)
        if experiment.name == "stick2d":
            part = replace(part, data=None, subjects=(), training=None)
        elif experiment.name == "clothed":
            licensed = options.data is not None and options.data != "builtin"
            # The subjects of CAPE are not those of DFaust.
            part = replace(part, data="cape" if licensed else None, subjects=() if licensed else options.subjects)
        chosen.append((experiment, part))
    if not chosen:
        raise UserError(_unknown_systems(options.systems, [row for one in EXPERIMENTS.values() for row in one.rows]))
    return chosen


def make_plan(experiment: Experiment, options: ExperimentOptions, resolve: Resolve) -> Plan:
    """Return the plan of one experiment.

    Runs are ordered by seed, then subject, then row, so that a whole table is complete early. All settings and subjects are
    checked before anything runs.

    Args:
        experiment: the experiment.
        options: its data, subjects, seeds, rows and settings.
        resolve: composes the configuration of `snarf train`.

    Raises:
        UserError: an option is unknown or cannot be used.
    """
    data = options.data or experiment.data[0]
    if data not in experiment.data:
        raise UserError(f"data: wanted {alternatives(experiment.data)} for {experiment.name}, got '{data}'")
    training = options.training or experiment.training
    presets = group_options("training")
    if training not in presets:
        raise UserError(f"there is no training={training}{nearest(training, presets)}; choose from {', '.join(presets)}")
    rows = _chosen_rows(experiment, options)
    if len(set(options.seeds)) != len(options.seeds) or not options.seeds or min(options.seeds) < 0:
        raise UserError(f"seeds: wanted different whole numbers from 0, at least one, got {list(options.seeds)}")
    _check_extra(options.extra, rows)
    resolved = {}
    for row in rows:
        preset = row.training or training
        try:
            resolved[row.key] = resolve((f"data={data}", f"training={preset}", *row.settings(preset), *options.extra))
        except UserError as error:
            raise UserError(f"row {row.key}: {error}") from None
    subjects = options.subjects or experiment.subjects.get(data, ())
    _check_subjects(experiment, data, subjects, options, resolved[rows[0].key]["data"])
    jobs = tuple(
        _job(row, data, subject, seed, row.training or training, options, resolved[row.key])
        for seed in options.seeds
        for subject in subjects
        for row in rows
    )
    plain = resolve((f"data={data}", f"training={training}", *options.extra))  # without the settings of a row
    chosen = replace(experiment, rows=tuple(rows))
    options_of_all = (data, tuple(subjects), options.seeds, training, options.extra)
    return Plan(chosen, *options_of_all, jobs, plain["training"], plain["data"])


def _chosen_rows(experiment: Experiment, options: ExperimentOptions) -> list[Row]:
    """Return the rows that `systems=` names, or all that are not optional."""
    unknown = [key for key in options.systems if key not in [row.key for row in experiment.rows]]
    if unknown:
        raise UserError(_unknown_systems(unknown, experiment.rows))
    if options.systems:
        return [row for row in experiment.rows if row.key in options.systems]
    return [row for row in experiment.rows if not row.is_optional]


def _job(
    row: Row, data: str, subject: str, seed: int, training: str, options: ExperimentOptions, resolved: dict[str, Any]
) -> Job:
    """Return one run, with the commands of its stages."""
    # Runs with different settings have different names, so that no table mixes them.
    name = f"{row.key}-{training}-s{seed}" + (f"-{_digest(list(options.extra))[:6]}" if options.extra else "")
    folder = run_folder(options.output_root, data, subject, name)
    root = options.data_root
    train_root = root if row.inside_test == "winding" else str(Path(root) / _PARITY_FOLDER)
    device, given = (f"device={options.device}",), (f"threads={options.threads}",) if options.threads else ()
    where = (_text("output_root", options.output_root), f"run={name}")
    settings = (*row.settings(training), *options.extra)
    steps = resolved["training"]["steps"] if row.minutes is None else None  # they are measured
    threads = given if row.minutes is None else ("threads=1",)  # so that other work on the machine hardly changes the result
    train = (
        "train", f"subject={quote(subject)}", f"data={data}", f"training={training}",
        *_curve_settings(data, steps, settings), *settings,
        f"seed={seed}", _text("data_root", train_root), *where, *device, *threads, "resume=true",
    )  # fmt: skip
    budget = [] if row.minutes is None else [row.minutes]
    return Job(
        row=row.key,
        label=row.label,
        data=data,
        subject=subject,
        seed=seed,
        folder=str(folder),
        samples=_samples_stages(data, subject, root, train_root, row.inside_test),
        train=train,
        evaluations=_evaluation_stages(data, subject, folder, options, where, (*device, *given)),
        digest=_digest([resolved, seed, data, subject, row.inside_test, *budget]),
        kind=_digest([resolved, data, row.inside_test, options.max_frames, options.surface_frames, *budget])[:16],
        steps=resolved["training"]["steps"],
        hint_s=60 * (row.minutes or row.cost * resolved["training"]["steps"] / _STEPS_OF_A_COST),
        minutes=row.minutes,
    )


def _curve_settings(data: str, steps: int | None, settings: Sequence[str]) -> tuple[str, ...]:
    """Return settings with which a training measures its IoU now and then, in and out of distribution; given ones stay."""
    curve = {} if steps is None else {"training.validate_every": max(1, steps // _VALIDATIONS)}
    if data not in _OTHER_OOD_DATA:
        curve["training.validation_ood_frames"] = _VALIDATION_OOD_FRAMES
    given = {setting.partition("=")[0] for setting in settings}
    return tuple(f"{name}={value}" for name, value in curve.items() if name not in given)


def _samples_stages(data: str, subject: str, root: str, train_root: str, inside_test: str) -> tuple[SamplesStage, ...]:
    """Return the samples for the evaluations, followed by those for the training if these are labelled differently."""

    def stage(data: str, root: str, *more: str) -> SamplesStage:
        arguments = ("preprocess", f"subject={quote(subject)}", f"data={data}", _text("data_root", root), *more)
        return SamplesStage(str(samples_folder(root, data, subject)), arguments)

    ood_data = _OTHER_OOD_DATA.get(data, data)
    stages = [stage(data, root)]
    if ood_data != data:
        stages.append(stage(ood_data, root))
    if train_root != root:
        # The samples go below another root than the one that has the files of the data set.
        files = () if data == "builtin" else (_text("data.folder", root), _text("body", root))
        stages.append(stage(data, train_root, f"inside_test={inside_test}", *files))
    return tuple(stages)


def _evaluation_stages(
    data: str, subject: str, folder: Path, options: ExperimentOptions, where: tuple[str, ...], machine: tuple[str, ...]
) -> tuple[EvaluationStage, ...]:
    """Return the evaluations in and out of distribution."""
    settings: dict[str, Any] = {"max_frames": options.max_frames, "surface_frames": options.surface_frames}
    given = [f"{key}={'null' if value is None else value}" for key, value in settings.items()]
    part = "_part" if options.max_frames is not None else ""
    stages = []
    for split, set_name in (("id", data), ("ood", _OTHER_OOD_DATA.get(data, data))):
        other = f"_{set_name}" if set_name != data else ""
        arguments = (
            "eval", f"subject={quote(subject)}", f"data={set_name}", f"split={split}",
            _text("data_root", options.data_root), *where, *given, "figure=false", *machine,
        )  # fmt: skip
        metrics = folder / f"eval_{split}{other}{part}" / "metrics.json"
        stages.append(EvaluationStage(split, set_name, options.data_root, arguments, str(metrics), settings))
    return tuple(stages)


def _check_extra(extra: Sequence[str], rows: Sequence[Row]) -> None:
    """Check that the further settings are not among those that the plan sets itself."""
    timed = [row.key for row in rows if row.minutes is not None]
    for override in extra:
        name = _name(override)
        if name in _OWN_SETTINGS:
            raise UserError(f"extra: {name} is set by reproduce itself; give {_OWN_SETTINGS[name]}")
        if timed and name == _STEPS:
            raise UserError(
                f"extra: {name} follows from the minutes of row {timed[0]}; leave it out, or choose other systems=[...]"
            )


def _sets_steps(extra: Sequence[str]) -> bool:
    return _STEPS in map(_name, extra)


def _name(override: str) -> str:
    """Return the name of the setting of an override."""
    return override.partition("=")[0].lstrip("+")


def _check_subjects(
    experiment: Experiment, data: str, subjects: Sequence[str], options: ExperimentOptions, config: dict[str, Any]
) -> None:
    """Check that every subject has samples, or meshes to make them from."""
    request = Request(DataConfig(**config), Path(options.data_root))
    missing = [one for one in subjects if not (samples_folder(options.data_root, data, one) / "manifest.json").exists()]
    if subjects and not missing:
        return
    known = tuple(find_dataset(data).subjects(request))
    if not subjects:
        raise UserError(f"{experiment.name} on data={data} needs subjects=[...]; it has {', '.join(known) or 'none'}")
    for subject in missing:
        if subject not in known:
            raise UserError(f"data={data} has no subject '{subject}'{nearest(subject, known)}; it has {', '.join(known)}")


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _text(name: str, value: str) -> str:
    return f"{name}={quote(value)}"


def _unknown_systems(keys: Sequence[str], rows: Sequence[Row]) -> str:
    known = list(dict.fromkeys(row.key for row in rows))
    return f"systems: there is no row '{keys[0]}'{nearest(keys[0], known)}; choose from {', '.join(known)}"
