"""`snarf train`: learn the avatar of one subject from processed samples."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

from snarfcli.avatar import Avatar
from snarfcli.bodies import MeshTemplate
from snarfcli.commands.train_settings import TrainConfig, check_settings
from snarfcli.datasets.builtin import require_subject
from snarfcli.deformer import CanonicalGrid
from snarfcli.deformer.grid_sides import with_grid_sides
from snarfcli.errors import UserError
from snarfcli.files import atomic_path, read_json, remove_temporaries, write_json
from snarfcli.fitting import RefinedPoses, refined_poses_text
from snarfcli.models.checkpoint import load_checkpoint
from snarfcli.models.preset import read_preset_weights
from snarfcli.models.settings import AvatarConfig
from snarfcli.models.shape_sizes import with_shape_sizes
from snarfcli.models.start_bones import with_start_bones
from snarfcli.models.symmetry import find_mirror
from snarfcli.models.trained_field import SYSTEMS
from snarfcli.native.backend import choose_backend
from snarfcli.output_locks import hold_all_inside, hold_output
from snarfcli.runs import choose_device, machine_facts, run_folder, seed_everything, set_threads
from snarfcli.samples.layout import samples_folder
from snarfcli.samples.store import SampleStore
from snarfcli.texts import counted
from snarfcli.training.loop import train
from snarfcli.training.rough_shape import rough_canonical_points
from snarfcli.training.trainer import CHECKPOINT_FORMAT, CHECKPOINT_VERSION, Diverged, Trainer
from snarfcli.versions import recorded_code

__all__ = ["TrainConfig", "new_trainer", "run"]

log = logging.getLogger(__name__)


def run(config: TrainConfig) -> None:
    """Train one subject and write the run folder: avatar, checkpoint, metrics, configuration, TensorBoard events.

    Raises:
        UserError: there are no samples, a setting cannot be used, or the folder has a run with other settings.
        OSError: the folder cannot be written to, or the disk is full.
    """
    check_settings(config)
    folder = run_folder(config.output_root, config.data.name, config.subject, config.run)
    device = choose_device(config.device)
    recorded_code()  # now, as the files may change while it trains
    with hold_output(folder, "snarf train", wait=config.wait):
        remove_temporaries(folder)
        trainer = _prepare(config, folder, device)
        if trainer is not None:
            _train(config, folder, trainer)


def _prepare(config: TrainConfig, folder: Path, device: torch.device) -> Trainer | None:
    """Return the trainer of a new or of an interrupted run; None if the run is complete."""
    checkpoint = folder / "checkpoint.pt"
    started = checkpoint.exists() or (folder / "avatar.pt").exists()
    if started and not (config.resume or config.overwrite):
        raise UserError(
            f"{folder} already has a run; give resume=true to continue it, overwrite=true to replace it, "
            "or run=NAME for another folder"
        )
    set_threads(config.threads)
    seed_everything(config.seed)
    if config.data.name == "builtin" and not samples_folder(config.data_root, "builtin", config.subject).exists():
        require_subject(config.subject)
    store = SampleStore.open(config.data_root, config.data.name, config.subject)
    sequences = store.sequences("train")
    frames = counted(sum(len(sequence.train_frames) for sequence in sequences), "frame")
    if config.training.validation_ood_frames:
        store.sequences("ood")  # raises if there are none
    among = counted(len(sequences), "sequence")
    log.info("data: %s, subject %s, %s, %s to train on", store.data, store.subject, among, frames)
    if config.search.backend == "native":
        choose_backend("native", device)  # raises before anything is written
    try:
        trainer = new_trainer(config, store, device)
    except ValueError as error:  # the message of a network or grid names the setting
        raise UserError(str(error)) from error
    if config.resume and started:
        state = load_checkpoint(checkpoint, CHECKPOINT_FORMAT, CHECKPOINT_VERSION, "checkpoint")
        trainer.restore(state, str(checkpoint))
        if trainer.step >= config.training.steps and _is_complete(folder, trainer):
            log.info("already trained: %s, nothing left to do", folder / "avatar.pt")
            return None
        log.info("resuming at step %d of %d", trainer.step, config.training.steps)
    elif config.overwrite and folder.exists():
        with hold_all_inside(folder, "snarf train", wait=config.wait):  # an evaluation, for example
            for path in folder.iterdir():  # not the folder itself, which may be a link
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                else:
                    path.unlink()
    return trainer


def _is_complete(folder: Path, trainer: Trainer) -> bool:
    """Return whether a run whose steps are done has all its files; the metrics are written last."""
    names = ("config.yaml", "avatar.pt", *(() if trainer.refiner is None else ("refined_poses.npz",)))
    try:
        metrics = read_json(folder / "metrics.json", "metrics")
    except UserError:
        return False
    return all((folder / name).is_file() for name in names) and isinstance(metrics, dict) and metrics.get("status") == "trained"


def _train(config: TrainConfig, folder: Path, trainer: Trainer) -> None:
    """Run all remaining steps and write the results."""
    _write_config(folder, config)
    parameters = sum(p.numel() for p in trainer.optimizer.parameters)
    steps = counted(config.training.steps, "step")
    log.info("run: %s, %s parameters, %s on %s", folder, f"{parameters:,}", steps, trainer.device)

    start = time.time()
    with _Scalars(folder, trainer.step) as on_scalars:
        try:
            result = train(trainer, folder, on_scalars=on_scalars)
        except KeyboardInterrupt:
            log.info("stopped at step %d; continue with resume=true", trainer.step)
            raise
        except Diverged as error:
            facts = {
                "status": "diverged",
                "reason": str(error),
                "steps": trainer.step,
                "checkpoint": (folder / "checkpoint.pt").exists(),
            }
            write_json(folder / "metrics.json", _facts(config) | facts | machine_facts(trainer.device))
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
        "validations": trainer.validations,
        "refined_poses": None if trainer.refiner is None else trainer.refiner.poses.summary(),
        "timings": {"wall_s": round(seconds, 2)} | {k: v for k, v in result.items() if k != "validation"},
        **machine_facts(trainer.device),
        "code": trainer.code,
        "earlier_code": trainer.earlier_code,
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
