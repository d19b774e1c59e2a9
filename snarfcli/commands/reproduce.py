"""`snarf reproduce`: make the papers' tables and figures, from training to the report.

Imports of Hydra stand inside functions: it takes a third of a second, which --help does not need.
"""

from __future__ import annotations

import logging
import re
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

from omegaconf import MISSING, OmegaConf

from snarfcli.checks import check_choice, check_number
from snarfcli.commands.train import TrainConfig
from snarfcli.errors import UserError
from snarfcli.files import remove_temporaries
from snarfcli.hydra_config.overrides import check_overrides, readable
from snarfcli.hydra_config.schema import config_folder, list_settings, preset_groups, register_schemas
from snarfcli.output_locks import hold_output
from snarfcli.reproduce.jobs import JobStatus, read_status
from snarfcli.reproduce.launchers import LAUNCHERS, Launcher
from snarfcli.reproduce.launching import check_launcher, default_processes, launch
from snarfcli.reproduce.planning import choose_experiments, make_plan
from snarfcli.reproduce.plans import ExperimentOptions, Job, Plan, unique_jobs
from snarfcli.reproduce.report import write_report
from snarfcli.reproduce.results import Result, collect
from snarfcli.reproduce.tables import plain_table
from snarfcli.runs import check_device

__all__ = ["ReproduceConfig", "resolve_training", "run"]

log = logging.getLogger(__name__)

# Settings that do not change the avatar, or only name the run; the second are those of `training`.
_NOT_OF_THE_AVATAR = (
    "subject", "seed", "run", "data_root", "output_root", "resume", "overwrite", "wait", "device", "threads",
)  # fmt: skip
_NOT_OF_THE_AVATAR_IN_TRAINING = (
    "workers", "graph", "validate_every", "validation_frames", "validation_ood_frames", "checkpoint_every",
)  # fmt: skip


@dataclass
class ReproduceConfig:
    """Settings of `snarf reproduce`."""

    what: str | None = MISSING
    """table1, table2, ablations, minutes, stick2d, clothed or all; can be given as first argument without its name."""
    subjects: list[str] = MISSING
    """Subjects; empty for 50002 and 50004 (built-in), or all ten (DFaust)."""
    seeds: list[int] = MISSING
    """Seeds; with several seeds the tables have standard deviations."""
    training: str | None = MISSING
    """Training preset; null for quick, or stick2d for the 2D stick (always with `all`)."""
    data: str | None = MISSING
    """Data set; null for builtin, stick2d or clothed. Licensed: dfaust (with PosePrior), and cape (clothed experiment)."""
    systems: list[str] = MISSING
    """Rows of the table, such as [nasa,ours-local] (--dry-run prints the names); empty for all."""
    extra: list[str] = MISSING
    """Further settings of every training, such as [training.steps=1000]; these runs have separate folders."""
    data_root: str = MISSING
    """Folder with the processed samples; missing samples are made."""
    output_root: str = MISSING
    """Folder for results; run folders are <output_root>/<data>/<subject>/<row>-<training>-s<seed>."""
    report: str | None = MISSING
    """Folder for tables and figures; null for <output_root>/reproduce/<what>."""
    launcher: str = MISSING
    """local (processes of this machine), or with a launcher of Hydra joblib, submitit_local or submitit_slurm."""
    processes: int | None = MISSING
    """Number of jobs at a time; null for one per GPU or core, as far as memory allows, or on a cluster for all jobs."""
    launcher_settings: list[str] = MISSING
    """Settings of Hydra's launcher, such as [partition=gpu,gpus_per_node=1]."""
    threads: int | None = MISSING
    """Threads per job; null shares the cores of this machine out among the jobs that run, or follows OMP_NUM_THREADS."""
    device: str = MISSING
    """auto, cpu, cuda or cuda:N."""
    max_frames: int | None = MISSING
    """Number of frames to evaluate; null for all."""
    surface_frames: int = MISSING
    """Number of frames in which the surface is compared with the ground truth (Chamfer, normals, F-score); 0 disables this."""
    figures: bool = MISSING
    """Draw figures."""
    figure_resolution: int = MISSING
    """Voxels along the longest side of the meshes in the figures."""
    only_report: bool = MISSING
    """Run nothing; write tables and figures of the existing results."""
    dry_run: bool = MISSING
    """Print the commands that would be run, and stop."""


def run(config: ReproduceConfig) -> int:
    """Run what is missing and write a report for each experiment; return 1 if a run has failed, 0 otherwise.

    Raises:
        UserError: an option is unknown or cannot be used; nothing has been run.
        OSError: a folder cannot be written to, or the disk is full.
    """
    _check(config)
    choice = ExperimentOptions(
        subjects=tuple(config.subjects), seeds=tuple(config.seeds), training=config.training, data=config.data,
        systems=tuple(config.systems), extra=tuple(config.extra), data_root=config.data_root,
        output_root=config.output_root, threads=config.threads, device=config.device, max_frames=config.max_frames,
        surface_frames=config.surface_frames,
    )  # fmt: skip
    plans = [make_plan(one, part, resolve_training) for one, part in choose_experiments(config.what, choice)]
    jobs = unique_jobs(plans)
    processes = config.processes or default_processes(config.launcher, len(jobs), config.device)
    launcher = Launcher(config.launcher, processes, config.threads, tuple(config.launcher_settings))
    if config.dry_run:
        _print_plan(jobs)
        return 0
    folders = [_report_folder(config, plan) for plan in plans]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)  # fails before the work if it cannot be written
    if not config.only_report:
        log.info("%d runs, launcher %s, %d at a time", len(jobs), config.launcher, processes)
        progress = _Progress(jobs, processes)
        try:
            launch(jobs, Path(config.output_root) / "reproduce" / "jobs", launcher, progress)
        except KeyboardInterrupt:
            log.info("stopped with %d of %d runs done; run the same command to continue", progress.done, len(jobs))
            raise
    results: list[Result] = []
    for plan, folder in zip(plans, folders, strict=True):
        of_plan = [collect(job) for job in plan.jobs]
        results += of_plan
        log.info("\n%s\n\n%s\n", plan.experiment.title, plain_table(plan, of_plan))
        undone = sum(result.state != "done" for result in of_plan)
        if undone:
            log.warning("warning: %d of %d runs are not done, so the exit code is 1; the report says why", undone, len(of_plan))
        resolution = config.figure_resolution if config.figures else None
        about = f"{processes} runs at a time" if processes > 1 and not config.only_report else ""
        with hold_output(folder, "snarf reproduce", wait=True):
            remove_temporaries(folder, recursive=True)
            written = write_report(plan, of_plan, folder, _command(config), about=about, figure_resolution=resolution)
        for path in written:
            log.info("written: %s", path)
    return 0 if all(result.state == "done" for result in results) else 1


def resolve_training(overrides: Sequence[str]) -> dict[str, Any]:
    """Return the configuration of `snarf train` for overrides, without the settings that do not change the avatar.

    Raises:
        UserError: an override names an unknown setting or option.
    """
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    overrides = [readable(override, list_settings(TrainConfig)) for override in overrides]
    check_overrides(overrides, TrainConfig, "train")
    presets = preset_groups(TrainConfig, "train")
    named = [override.partition("=") for override in overrides]
    overrides = [f"{presets.get(name, name)}={value}" for name, _, value in named]
    register_schemas("train", TrainConfig)
    running = GlobalHydra.instance().hydra  # Hydra of this command; only one can be active
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(config_folder().absolute()), version_base="1.3"):
            config = cast(dict[str, Any], OmegaConf.to_container(compose("train", list(overrides)), resolve=True))
    finally:
        GlobalHydra.instance().clear()
        if running is not None:
            GlobalHydra.instance().initialize(running)
    for name in _NOT_OF_THE_AVATAR:
        config.pop(name)
    for name in _NOT_OF_THE_AVATAR_IN_TRAINING:
        config["training"].pop(name)
    return config


def _check(config: ReproduceConfig) -> None:
    """Check all settings before any work starts."""
    check_choice("launcher", config.launcher, LAUNCHERS)
    for name, least in {"processes": 1, "threads": 1, "max_frames": 1, "surface_frames": 0, "figure_resolution": 16}.items():
        check_number(name, getattr(config, name), least)
    for one in config.launcher_settings:
        if "=" not in one:
            raise UserError(f"launcher_settings: wanted settings such as [partition=gpu], got '{one}'")
    if config.launcher != "submitit_slurm":  # a cluster may have devices that this machine lacks
        check_device(config.device)
    if not (config.dry_run or config.only_report):
        check_launcher(config.launcher, config.launcher_settings)


def _report_folder(config: ReproduceConfig, plan: Plan) -> Path:
    name = plan.experiment.name
    if config.report is None:
        return Path(config.output_root) / "reproduce" / name
    return Path(config.report) / name if config.what == "all" else Path(config.report)


def _print_plan(jobs: Sequence[Job]) -> None:
    """Print each run and its commands."""
    made: set[str] = set()
    for number, job in enumerate(jobs, 1):
        log.info("run %d of %d: %s: %s, %s", number, len(jobs), job.row, job.name, job.folder)
        for samples in job.samples:
            if samples.folder not in made and not (Path(samples.folder) / "manifest.json").exists():
                log.info("  snarf %s", " ".join(samples.arguments))
            made.add(samples.folder)
        for arguments in (job.train, *(evaluation.arguments for evaluation in job.evaluations)):
            log.info("  snarf %s", " ".join(arguments))


def _command(config: ReproduceConfig) -> str:
    """Return the command line, with the settings that differ from the defaults."""
    path = config_folder() / "reproduce" / "reproduce.yaml"
    defaults = cast(dict[str, Any], OmegaConf.to_container(OmegaConf.load(path)))
    words = ["snarf", "reproduce", str(config.what)]
    for name, value in asdict(config).items():
        if name not in ("what", "only_report", "dry_run") and value != defaults[name]:
            word = f"{name}={_written(value)}"
            words.append(word if re.fullmatch(r"[\w.,=/:+\-\[\]]*", word) else shlex.quote(word))
    return " ".join(words)


def _written(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ",".join(map(str, value)) + "]"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


class _Progress:
    """Prints one line when a run starts, and one when it ends."""

    def __init__(self, jobs: Sequence[Job], processes: int) -> None:
        self.jobs, self.processes = jobs, processes
        self.done = 0
        self._ended: set[int] = set()
        self._worked_s: list[float] = []

    def __call__(self, number: int, status: JobStatus) -> None:
        job = self.jobs[number]
        if status.state == "running":
            log.info("started: %s (%s)", job.name, Path(job.folder) / "reproduce.log")
            return
        if status.state == "stopped" or status.retry:
            return
        self._ended.add(number)
        self.done += status.state == "done"
        seconds = sum(status.seconds.values())
        if seconds:
            self._worked_s.append(seconds)
        log.info("%d of %d: %s: %s%s", len(self._ended), len(self.jobs), job.name, self._outcome(job, status), self._left())

    def _outcome(self, job: Job, status: JobStatus) -> str:
        if status.state != "done":
            return f"{status.state} ({status.stage}: {status.reason})" if status.reason else status.state
        values = collect(job).values
        parts = [
            f"{name} " + "/".join(f"{values[key]:.1f}" if key in values else "-" for key in (f"{name}_id", f"{name}_ood"))
            for name in ("bbox", "surface")
        ]
        seconds = sum(status.seconds.values())
        return ", ".join([*parts, "IoU in/out of distribution", f"{seconds:.0f} s" if seconds else "existed already"])

    @staticmethod
    def _is_there(job: Job) -> bool:
        status = read_status(Path(job.folder))
        return status is not None and status.state == "done" and status.digest == job.digest

    def _left(self) -> str:
        """Return an estimate of the remaining time, from the mean duration of the finished runs."""
        left = sum(number not in self._ended and not self._is_there(job) for number, job in enumerate(self.jobs))
        if not left or not self._worked_s:
            return ""
        seconds = sum(self._worked_s) / len(self._worked_s) * left / min(self.processes, left)
        return f"; about {seconds / 60:.0f} min left" if seconds >= 60 else f"; about {seconds:.0f} s left"
