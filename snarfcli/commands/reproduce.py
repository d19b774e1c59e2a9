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
from snarfcli.parallel import count_cores
from snarfcli.reproduce.dry_run import measure_missing, print_commands, print_durations
from snarfcli.reproduce.durations import Durations, longest_first, machine_name
from snarfcli.reproduce.growing import GrowingReports, PlannedReport
from snarfcli.reproduce.launchers import LAUNCHERS, Launcher
from snarfcli.reproduce.launching import check_launcher, default_processes, launch
from snarfcli.reproduce.planning import choose_experiments, make_plan
from snarfcli.reproduce.plans import ExperimentOptions, Job, Plan, unique_jobs
from snarfcli.reproduce.progress import PlanProgress
from snarfcli.reproduce.provenance import code_versions
from snarfcli.reproduce.report import write_report
from snarfcli.reproduce.results import collect
from snarfcli.reproduce.tables import plain_table
from snarfcli.runs import check_device, machine_facts
from snarfcli.texts import counted

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
    """Print the commands that would be run and how long they would take, and stop."""
    measure: bool = MISSING
    """With dry_run, measure a short run of every row that has no finished one; false for an estimate at once."""


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
    work = Path(config.output_root) / "reproduce"
    # The machines of a cluster are not this one, so what runs there is not measured here.
    machine = None if launcher.name == "submitit_slurm" else machine_name(machine_facts()["machine"])
    threads = launcher.threads or max(1, count_cores() // launcher.processes)
    durations = Durations(work / "durations.json", jobs, machine, threads)
    jobs = longest_first(jobs, durations)
    if config.dry_run:
        print_commands(jobs)
        if config.measure and machine is not None:
            measure_missing(plans, jobs, durations)
        print_durations(jobs, durations, launcher.processes)
        return 0
    about = f"{launcher.processes} runs at a time" if launcher.processes > 1 and not config.only_report else ""
    reports = [PlannedReport(plan, _report_folder(config, plan), _command(config), about) for plan in plans]
    for report in reports:
        report.folder.mkdir(parents=True, exist_ok=True)  # fails before the work if it cannot be written
    if not config.only_report:
        _run_jobs(jobs, launcher, durations, reports, work / "jobs")
    resolution = config.figure_resolution if config.figures else None
    are_done = [_finish(report, resolution) for report in reports]
    return 0 if all(are_done) else 1


def _run_jobs(
    jobs: Sequence[Job], launcher: Launcher, durations: Durations, reports: Sequence[PlannedReport], folder: Path
) -> None:
    """Run what is missing, show the progress, and let the reports grow."""
    growing = GrowingReports(reports)

    def grow(number: int) -> None:
        growing.update(jobs[number].folder, {jobs[other].folder for other in progress.running})

    progress = PlanProgress(jobs, launcher.processes, durations, grow)
    log.info("launcher %s, %s at a time", launcher.name, counted(launcher.processes, "run"))
    progress.begin()
    try:
        launch(jobs, folder, launcher, progress.on_change, progress.look)
    except KeyboardInterrupt:
        progress.close()
        growing.stop()
        runs = counted(len(jobs), "run")
        log.info("stopped with %d of %s done; run the same command to continue from the last checkpoints", progress.done, runs)
        raise
    finally:
        progress.close()


def _finish(report: PlannedReport, figure_resolution: int | None) -> bool:
    """Print the table of a plan, write its report, and return whether all its runs are done."""
    plan, results = report.plan, [collect(job) for job in report.plan.jobs]
    log.info("\n%s\n\n%s\n", plan.experiment.title, plain_table(plan, results))
    undone = sum(result.state != "done" for result in results)
    if undone:
        runs = counted(len(results), "run")
        log.warning("warning: %d of %s not done, so the exit code is 1; the report says why", undone, runs)
    versions = code_versions(results)
    if len(versions) > 1:
        log.warning(
            "warning: the runs are from %d versions of the code (%s); the report lists them; to have one version, delete the "
            "folders of the other runs, or give another output_root", len(versions), "; ".join(versions),
        )  # fmt: skip
    with hold_output(report.folder, "snarf reproduce", wait=True):
        remove_temporaries(report.folder, recursive=True)
        written = write_report(
            plan, results, report.folder, report.command, about=report.about, figure_resolution=figure_resolution
        )
    for path in written:
        log.info("written: %s", path)
    return not undone


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


def _command(config: ReproduceConfig) -> str:
    """Return the command line, with the settings that differ from the defaults."""
    path = config_folder() / "reproduce" / "reproduce.yaml"
    defaults = cast(dict[str, Any], OmegaConf.to_container(OmegaConf.load(path)))
    words = ["snarf", "reproduce", str(config.what)]
    for name, value in asdict(config).items():
        if name not in ("what", "only_report", "dry_run", "measure") and value != defaults[name]:
            word = f"{name}={_written(value)}"
            words.append(word if re.fullmatch(r"[\w.,=/:+\-\[\]]*", word) else shlex.quote(word))
    return " ".join(words)


def _written(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ",".join(map(str, value)) + "]"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
