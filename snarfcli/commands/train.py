"""`snarf train`: learn the avatar of one subject from processed samples."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import MISSING, OmegaConf

from snarfcli.avatar import Avatar
from snarfcli.bodies import MeshTemplate
from snarfcli.checks import check_choice, check_number
from snarfcli.commands.deformer_checks import check_search, check_skinning
from snarfcli.datasets.builtin import require_subject
from snarfcli.datasets.settings import DataConfig
from snarfcli.deformer import CanonicalGrid, SearchConfig, SkinningConfig
from snarfcli.errors import UserError
from snarfcli.files import atomic_path, write_json
from snarfcli.fitting import RefinedPoses, refined_poses_text
from snarfcli.models.checkpoint import load_checkpoint
from snarfcli.models.grid_sides import with_grid_sides
from snarfcli.models.preset import read_preset_weights
from snarfcli.models.settings import AvatarConfig, ModelConfig
from snarfcli.models.shape_sizes import with_shape_sizes
from snarfcli.models.start_bones import with_start_bones
from snarfcli.models.symmetry import find_mirror
from snarfcli.models.trained_field import SYSTEMS
from snarfcli.precision import PRECISIONS
from snarfcli.runs import choose_device, machine_facts, run_folder, seed_everything, set_threads
from snarfcli.samples.layout import samples_folder
from snarfcli.samples.store import SampleStore
from snarfcli.shape import CONDITIONS, ConditionConfig, ShapeConfig
from snarfcli.training.loop import train
from snarfcli.training.losses import JOINT_TARGETS
from snarfcli.training.rough_shape import rough_canonical_points
from snarfcli.training.settings import TrainingConfig
from snarfcli.training.trainer import CHECKPOINT_FORMAT, CHECKPOINT_VERSION, Diverged, Trainer

__all__ = ["TrainConfig", "new_trainer", "run"]

log = logging.getLogger(__name__)

_AT_LEAST_ONE = (
    "steps", "poses_per_step", "bone_points", "validate_every", "checkpoint_every", "agreement_every", "agreement_points",
)  # fmt: skip
_NOT_NEGATIVE = (
    "uniform_points", "surface_points", "far_points", "warmup_steps", "bootstrap_steps", "bone_occupancy_weight",
    "joint_weight", "validation_frames", "refresh_cells_every", "extend_weights_every", "workers",
    "agreement_weight",
)  # fmt: skip
_LEAST_OF_MODEL = {"part_width": 1, "part_depth": 1, "part_code": 0, "part_weight": 0, "part_points": 1, "components": 1}


@dataclass
class TrainConfig:
    """Settings of `snarf train`."""

    subject: str = MISSING
    """Subject of the avatar, such as 50002."""
    data: DataConfig = MISSING
    """Data set of the samples."""
    model: ModelConfig = MISSING
    """System of the papers."""
    skinning: SkinningConfig = MISSING
    """Field of skinning weights."""
    search: SearchConfig = MISSING
    """Correspondence search."""
    shape: ShapeConfig = MISSING
    """Canonical occupancy network."""
    condition: ConditionConfig = MISSING
    """Pose condition of the canonical points."""
    training: TrainingConfig = MISSING
    """Steps, batches and losses."""
    data_root: str = MISSING
    """Folder with the processed samples."""
    output_root: str = MISSING
    """Folder for results; the run folder is <output_root>/<data>/<subject>/<run>."""
    run: str = MISSING
    """Name of the run."""
    resume: bool = MISSING
    """Continue an interrupted run in the same folder; a finished run is not changed."""
    overwrite: bool = MISSING
    """Replace an existing run in the same folder."""
    device: str = MISSING
    """auto, cpu, cuda or cuda:N."""
    threads: int | None = MISSING
    """Threads for tensor work; null keeps PyTorch's choice."""
    seed: int = MISSING
    """Seed of all random numbers."""
    experiment: str | None = None
    """Preset of settings, which other settings override; null for none."""


def run(config: TrainConfig) -> None:
    """Train one subject and write the run folder: avatar, checkpoint, metrics, configuration, TensorBoard events.

    Raises:
        UserError: there are no samples, a setting cannot be used, or the folder has a run with other settings.
        OSError: the folder cannot be written to, or the disk is full.
    """
    _check(config)
    folder = run_folder(config.output_root, config.data.name, config.subject, config.run)
    checkpoint = folder / "checkpoint.pt"
    started = checkpoint.exists() or (folder / "avatar.pt").exists()
    if started and not (config.resume or config.overwrite):
        raise UserError(
            f"{folder} already has a run; give resume=true to continue it, overwrite=true to replace it, "
            "or run=NAME for another folder"
        )
    device = choose_device(config.device)
    set_threads(config.threads)
    seed_everything(config.seed)
    if config.data.name == "builtin" and not samples_folder(config.data_root, "builtin", config.subject).exists():
        require_subject(config.subject)
    store = SampleStore.open(config.data_root, config.data.name, config.subject)
    sequences = store.sequences("train")
    frames = sum(len(sequence.train_frames) for sequence in sequences)
    log.info("data: %s, subject %s, %d sequences, %d frames to train on", store.data, store.subject, len(sequences), frames)

    try:
        trainer = new_trainer(config, store, device)
    except ValueError as error:  # the message of a network or grid names the setting
        raise UserError(str(error)) from error
    if config.resume and started:
        state = load_checkpoint(checkpoint, CHECKPOINT_FORMAT, CHECKPOINT_VERSION, "checkpoint")
        trainer.restore(state, str(checkpoint))
        results = ["avatar.pt"] if trainer.refiner is None else ["avatar.pt", "refined_poses.npz"]
        if trainer.step >= config.training.steps and all((folder / name).exists() for name in results):
            log.info("already trained: %s, nothing left to do", folder / "avatar.pt")
            return
        log.info("resuming at step %d of %d", trainer.step, config.training.steps)
    elif config.overwrite and folder.exists():
        shutil.rmtree(folder)
    _write_config(folder, config)
    parameters = sum(p.numel() for p in trainer.optimizer.parameters)
    log.info("run: %s, %s parameters, %d steps on %s", folder, f"{parameters:,}", config.training.steps, device)

    start = time.time()
    with _Scalars(folder, trainer.step) as on_scalars:
        try:
            result = train(trainer, folder, on_scalars=on_scalars)
        except KeyboardInterrupt:
            log.info("stopped at step %d; continue with resume=true", trainer.step)
            raise
        except Diverged as error:
            facts = {"status": "diverged", "reason": str(error), "steps": trainer.step, "checkpoint": checkpoint.exists()}
            write_json(folder / "metrics.json", _facts(config) | facts | machine_facts())
            raise
    finished = trainer.finished_avatar()
    finished.facts |= {"steps": trainer.step, "validation": result["validation"]}
    finished.save(folder / "avatar.pt")
    if trainer.refiner is not None:
        trainer.refiner.finish(finished)
        trainer.refiner.poses.write(folder / "refined_poses.npz")
        _report_poses(trainer.refiner.poses, folder)
    write_json(folder / "metrics.json", _metrics(config, result, trainer, time.time() - start))
    validation = result["validation"]
    if validation:
        log.info(
            "validation (held-back motion%s): IoU bbox %.2f %%, surface %.2f %%",
            "" if trainer.refiner is None else ", poses fitted to the meshes",
            100 * validation["iou_bbox"],
            100 * validation["iou_surface"],
        )
    log.info("avatar: %s", folder / "avatar.pt")


def _report_poses(poses: RefinedPoses, folder: Path) -> None:
    """Report the refined poses, and warn of those that do not fit the meshes."""
    summary = poses.summary()
    log.info("%s: %s", refined_poses_text(summary), folder / "refined_poses.npz")
    failed, frames = poses.count_misfits(), poses.num_frames
    if failed:
        log.warning(
            "warning: the poses of %d of %d frames could not be refined (their meshes are more than %.1f cm from the avatar) "
            "and stay as given; the run is kept; train for more steps, start from better poses, or leave these frames out",
            failed, frames, 100 * poses.misfit_m,
        )  # fmt: skip


def _check(config: TrainConfig) -> None:
    """Check all settings before any work starts."""
    training = config.training
    for name in _AT_LEAST_ONE:
        check_number(f"training.{name}", getattr(training, name), 1)
    for name in _NOT_NEGATIVE:
        check_number(f"training.{name}", getattr(training, name), 0)
    if training.uniform_points + training.surface_points == 0:
        raise UserError(
            "training.uniform_points, training.surface_points: wanted at least one point, got 0 and 0; set one of them"
        )
    check_number("training.learning_rate", training.learning_rate, 0, 1)
    check_number("training.final_learning_rate", training.final_learning_rate, 0, 1)
    check_number("training.average_decay", training.average_decay, 0, 1)
    check_choice("training.precision", training.precision, PRECISIONS)
    check_choice("training.joint_target", training.joint_target, JOINT_TARGETS)
    check_choice("shape.name", config.shape.name, ("mlp", "grid"))
    if (config.shape.name == "grid") != bool(config.shape.feature_cells_m):
        cells = config.shape.feature_cells_m
        wanted = "at least one number for shape=grid" if not cells else "none for shape=mlp, which has no feature grids"
        raise UserError(f"shape.feature_cells_m: wanted {wanted}, got {cells}; give shape=grid")
    check_choice("condition.name", config.condition.name, CONDITIONS)
    for name in ("width", "depth"):
        check_number(f"shape.{name}", getattr(config.shape, name), 1)
    if config.condition.name != "none":
        check_number("condition.layer", config.condition.layer, 0, config.shape.depth - 1)
        for name, size in (("condition.size", config.condition.size), ("shape.condition_size", config.shape.condition_size)):
            check_number(name, size, 1)
    check_choice("model.name", config.model.name, SYSTEMS)
    for name, least in _LEAST_OF_MODEL.items():
        check_number(f"model.{name}", getattr(config.model, name), least)
    if config.model.name == "snarf" and config.search.name != "broyden":
        raise UserError(
            f"search: wanted snarf or broyden with model=snarf, got {config.search.name}; give one of them, or leave search out"
        )
    check_skinning(config.skinning, config.search)
    if config.model.name != "fast_snarf" and config.skinning.name == "preset":
        raise UserError(
            f"skinning={config.skinning.name} is for model=fast_snarf, got model={config.model.name}; leave skinning out"
        )
    check_search(config.search)
    check_number("seed", config.seed, 0)


def new_trainer(config: TrainConfig, store: SampleStore, device: torch.device) -> Trainer:
    """Return the trainer of a new, untrained avatar of the store's subject."""
    template = _template(config.model.name, store)
    search = with_start_bones(config.search, store.skeleton)
    surface = rough_canonical_points(store)
    mirror = find_mirror(store.skeleton) if config.skinning.symmetric else None
    extent = surface if mirror is None else mirror.complete(surface)
    skinning = with_grid_sides(config.skinning, extent, store.skeleton)
    shape = with_shape_sizes(config.shape, surface, store.skeleton)
    grid = CanonicalGrid.around(extent, skinning.margin_m)
    field = None
    if skinning.name == "preset":
        assert skinning.weights_file is not None  # see check_skinning
        width, height, depth = skinning.resolution
        field = read_preset_weights(skinning.weights_file, grid, (depth, height, width), store.skeleton.num_joints)
    avatar = Avatar(
        AvatarConfig(config.model, skinning, search, shape, config.condition),
        store.skeleton,
        grid,
        surface,
        {"data": store.data, "subject": store.subject, "seed": config.seed, "training": config.training.name},
        field,
        template,
    )
    return Trainer(avatar, store, config.training, config.seed, device)


def _template(model: str, store: SampleStore) -> MeshTemplate | None:
    """Return the subject's mesh with ground-truth skinning weights if the system uses them, else None.

    Raises:
        UserError: the samples have none.
    """
    if not SYSTEMS[model].needs_template:
        return None
    if store.template is None:
        raise UserError(
            f"model={model} needs a mesh with ground-truth skinning weights, which the samples of {store.data} "
            f"{store.subject} do not have; choose another model, or data made with a body model or a rig"
        )
    return store.template


def _write_config(folder: Path, config: TrainConfig) -> None:
    """Write the resolved configuration."""
    with atomic_path(folder / "config.yaml") as temporary:
        OmegaConf.save(OmegaConf.structured(config), temporary)


def _metrics(config: TrainConfig, result: dict[str, Any], trainer: Trainer, seconds: float) -> dict[str, Any]:
    """Return the content of `metrics.json` after a training run."""
    validation = result["validation"]
    held_back = sum(len(sequence.val_frames) for sequence in trainer.store.sequences("train"))
    return {
        **_facts(config),
        "status": "trained",
        "split": "validation",
        "iou_bbox": validation.get("iou_bbox"),
        "iou_surface": validation.get("iou_surface"),
        "frames": min(config.training.validation_frames, held_back),
        "steps": trainer.step,
        "refined_poses": None if trainer.refiner is None else trainer.refiner.poses.summary(),
        "timings": {"wall_s": round(seconds, 2)} | {k: v for k, v in result.items() if k != "validation"},
        **machine_facts(),
    }


def _facts(config: TrainConfig) -> dict[str, Any]:
    """Return the content of `metrics.json` that a failed run has too."""
    return {
        "data": config.data.name,
        "subject": config.subject,
        "model": config.model.name,
        "seed": config.seed,
        "training": asdict(config.training),
    }


class _Scalars:
    """TensorBoard writer of a run folder; a context manager that yields the function (step, named numbers)."""

    def __init__(self, folder: Path, step: int) -> None:
        self.folder, self.step = folder, step

    def __enter__(self) -> Callable[[int, dict[str, float]], None]:
        from torch.utils.tensorboard import SummaryWriter  # takes seconds, and is needed only now

        self.writer = SummaryWriter(str(self.folder / "tensorboard"), purge_step=self.step or None)
        return self.write

    def write(self, step: int, numbers: dict[str, float]) -> None:
        for name, value in numbers.items():
            self.writer.add_scalar(name, value, step)

    def __exit__(self, *exception: object) -> None:
        self.writer.close()
