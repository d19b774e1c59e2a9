"""`snarf eval`: measure the IoU of a trained avatar on held-out motion or on out-of-distribution poses."""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from omegaconf import MISSING

from snarfcli.avatar import Avatar
from snarfcli.checks import check_choice, check_number
from snarfcli.commands.deformer_checks import check_search
from snarfcli.commands.search_names import search_name
from snarfcli.datasets.builtin import builtin_subject
from snarfcli.datasets.settings import DataConfig
from snarfcli.deformer import SearchConfig
from snarfcli.errors import UserError
from snarfcli.evaluation.evaluate import choose_frames, evaluate
from snarfcli.evaluation.figure import write_figure
from snarfcli.evaluation.report import SPLITS, STORE_SPLITS, EvaluationReport, metrics_content, table, timings_text
from snarfcli.evaluation.surface_metrics import measure_surfaces, surfaces_text
from snarfcli.evaluation.weight_metrics import measure_weights, weights_text
from snarfcli.files import remove_temporaries, write_json
from snarfcli.fitting import PoseRefiner, refined_poses_text, require_refinable
from snarfcli.models.start_bones import with_start_bones
from snarfcli.output_locks import hold_output
from snarfcli.precision import PRECISIONS
from snarfcli.runs import choose_device, find_avatar, machine_facts, seed_everything, set_threads
from snarfcli.samples.layout import samples_folder
from snarfcli.samples.store import SampleStore
from snarfcli.texts import counted, one_line
from snarfcli.versions import recorded_code

__all__ = ["EvalConfig", "run"]

log = logging.getLogger(__name__)


@dataclass
class EvalConfig:
    """Settings of `snarf eval`."""

    subject: str = MISSING
    """Subject of the avatar, such as 50002."""
    data: DataConfig = MISSING
    """Data set of the samples."""
    search: SearchConfig | None = None
    """Correspondence search; null for the one that the avatar was trained with."""
    data_root: str = MISSING
    """Folder with the processed samples."""
    output_root: str = MISSING
    """Folder with the runs; the avatar is <output_root>/<data>/<subject>/<run>/avatar.pt."""
    run: str = MISSING
    """Name of the run."""
    split: str = MISSING
    """id (held-out motion) or ood (out-of-distribution poses)."""
    ckpt: str | None = MISSING
    """Avatar file or run folder to evaluate instead; results are written beside it."""
    max_frames: int | None = MISSING
    """Number of frames to evaluate, evenly spaced; null for all."""
    points: int | None = MISSING
    """Number of points per frame, half uniform, half near the surface; null for all."""
    refine_poses: bool = MISSING
    """Fit the pose of every frame to its mesh first, for poses that are only nearly right; the results say so."""
    surface_frames: int = MISSING
    """Number of frames in which the surface is compared with the ground truth (Chamfer, normals, F-score); 0 disables this."""
    surface_resolution: int = MISSING
    """Voxels along the longest side of these surfaces."""
    figure: bool = MISSING
    """Draw the worst and the best frames."""
    figure_frames: int = MISSING
    """Number of worst frames, and of best frames, to draw."""
    figure_resolution: int = MISSING
    """Voxels along the longest side of the meshes in the figure."""
    wait: bool = False
    """Wait while another command writes to the output folder, instead of stopping with an error."""
    device: str = MISSING
    """auto, cpu, cuda or cuda:N."""
    threads: int | None = MISSING
    """Threads for tensor work; null keeps PyTorch's choice."""
    precision: str = "highest"
    """Precision of the shape network on a GPU: highest (float32), high or medium (TF32) or bfloat16. On a CPU the native
    library computes in float32."""
    seed: int = MISSING
    """Seed of the selection of points."""
    experiment: str | None = None
    """Preset of settings, which other settings override; null for none."""


def run(config: EvalConfig) -> None:
    """Evaluate one avatar: print the table, write `metrics.json` and the figure to `eval_<split>` in the run folder.

    Raises:
        UserError: the avatar or the samples do not exist or do not belong together, or a setting cannot be used.
    """
    _check(config)
    trained_on = config.data.avatars or config.data.name
    path = find_avatar(config.output_root, trained_on, config.subject, config.run, config.ckpt)
    device = choose_device(config.device)
    set_threads(config.threads)
    seed_everything(config.seed)
    recorded_code()  # now, as the files may change while it measures
    store = SampleStore.open(config.data_root, config.data.name, config.subject)
    sequences = store.sequences(STORE_SPLITS[config.split])
    avatar = Avatar.load(path, device).with_precision(config.precision)
    _check_match(avatar, store, config)
    if config.search is not None:
        try:
            avatar.model.choose_search(with_start_bones(config.search, avatar.skeleton))
        except ValueError as error:
            raise UserError(f"{error}; leave search out, or give search=snarf for an avatar of model=snarf") from None
    folder = path.parent / _folder_name(config, avatar)
    _check_writable(folder)
    log.info(
        "data: %s, subject %s, %s: %s, %s",
        store.data, store.subject, SPLITS[config.split], counted(len(sequences), "sequence"),
        counted(sum(s.num_frames for s in sequences), "frame"),
    )  # fmt: skip
    search = search_name(config.search) if config.search else avatar.model.search and avatar.model.search.name
    log.info("avatar: %s, %s, on %s", path, f"search {search}" if search else avatar.config.model.name, device)

    with hold_output(folder, "snarf eval", wait=config.wait):
        remove_temporaries(folder)
        _evaluate(config, avatar, path, store, folder)


def _evaluate(config: EvalConfig, avatar: Avatar, path: Path, store: SampleStore, folder: Path) -> None:
    """Measure the avatar of the file `path`, and write the results to a folder."""
    sequences, search = store.sequences(STORE_SPLITS[config.split]), avatar.model.search
    refined = _refine(config, avatar, store) if config.refine_poses else None
    start = time.perf_counter()
    frames = evaluate(
        avatar,
        sequences,
        max_frames=config.max_frames,
        points=config.points,
        seed=config.seed,
        desc=f"eval {config.subject} {config.split}",
    )
    evaluation = EvaluationReport(
        data=store.data,
        subject=store.subject,
        model=avatar.config.model.name,
        split=config.split,
        frames=frames,
        wall_s=time.perf_counter() - start,
        machine=machine_facts(avatar.device),
        device=str(avatar.device),
        training=avatar.facts,
        search=asdict(search) if search else {},
        refined_poses=refined,
        samples=store.manifest["settings"],
    )
    log.info("\n%s\n\n%s", table(evaluation), timings_text(evaluation))
    surfaces = None
    if config.surface_frames:
        surfaces = measure_surfaces(avatar, sequences, config.surface_frames, config.surface_resolution)
        log.info("%s", surfaces_text(surfaces))
    weights = measure_weights(avatar, store.template)
    if weights is not None:
        log.info("%s", weights_text(weights))
    _check_finite("surfaces", surfaces)
    _check_finite("weights", weights)
    (folder / "frames.png").unlink(missing_ok=True)  # an older figure does not belong to these numbers
    content = metrics_content(evaluation, {**asdict(config), "avatar": str(path)})
    write_json(folder / "metrics.json", {**content, "surfaces": surfaces, "weights": weights})
    log.info("metrics: %s", folder / "metrics.json")
    if config.figure:
        write_figure(
            folder / "frames.png",
            avatar,
            sequences,
            frames,
            count=config.figure_frames,
            resolution=config.figure_resolution,
            title=evaluation.title,
        )
        log.info("figure: %s", folder / "frames.png")


def _check(config: EvalConfig) -> None:
    """Check all settings before any work starts."""
    check_choice("split", config.split, SPLITS)
    check_choice("precision", config.precision, PRECISIONS)
    least = {
        "max_frames": 1, "points": 2, "surface_frames": 0, "surface_resolution": 16, "figure_frames": 1,
        "figure_resolution": 16, "seed": 0,
    }  # fmt: skip
    for name, value in least.items():
        check_number(name, getattr(config, name), value)
    if config.search is not None:
        check_search(config.search)
    samples = samples_folder(config.data_root, config.data.name, config.subject)
    if config.data.name == "builtin" and not samples.exists():
        builtin_subject(config.subject)  # raises for an unknown subject, with the most similar name


def _refine(config: EvalConfig, avatar: Avatar, store: SampleStore) -> dict[str, float]:
    """Fit the poses of all frames that are measured to their meshes; return how much they changed.

    Raises:
        UserError: the poses of these samples cannot be refined with this avatar.
    """
    try:
        require_refinable(avatar, store, "refine_poses")
    except ValueError as error:
        raise UserError(str(error)) from None
    sequences = store.sequences(STORE_SPLITS[config.split])
    refiner = PoseRefiner(sequences, avatar.skeleton, avatar.device, config.seed)
    frames = choose_frames(sequences, config.max_frames)
    if config.surface_frames:
        known = {(id(sequence), index) for sequence, index in frames}
        more = choose_frames(sequences, config.surface_frames)
        frames += [(sequence, index) for sequence, index in more if (id(sequence), index) not in known]
    refiner.refine_all(avatar, frames, desc="refine poses")
    log.info("%s", refined_poses_text(refiner.poses.summary()))
    return refiner.poses.summary()


def _check_match(avatar: Avatar, store: SampleStore, config: EvalConfig) -> None:
    """Reject an avatar of another skeleton; warn about another subject or other training data."""
    theirs, ours = avatar.skeleton, store.skeleton
    if theirs.parents != ours.parents:
        raise UserError(
            f"wanted samples of the avatar's skeleton ({theirs.num_joints} joints), got another with {ours.num_joints} "
            f"(subject {store.subject}); evaluate the avatar on the data that it was trained on"
        )
    for name, wanted in (("subject", store.subject), ("data", store.data)):
        trained_on = avatar.facts.get(name)
        if trained_on is not None and str(trained_on) not in (wanted, config.data.avatars):
            trained_on = one_line(str(trained_on), 60)
            log.warning("warning: this avatar was trained on %s %s and is evaluated on %s %s", name, trained_on, name, wanted)


def _check_finite(name: str, results: Mapping[str, Any] | None) -> None:
    """Check that no result is NaN or infinite, which JSON cannot express.

    Raises:
        UserError: one is.
    """
    for key, value in (results or {}).items():
        if isinstance(value, float) and not math.isfinite(value):
            raise UserError(f"{name}.{key} is {value}, so nothing was written; the avatar or the samples are damaged")


def _folder_name(config: EvalConfig, avatar: Avatar) -> str:
    """Return the name of the output folder.

    Results of refined poses, of another search, data set or subject, or of a part of the points, must not replace the full
    evaluation.
    """
    parts = ["eval", config.split]
    if config.refine_poses:
        parts.append("refined")
    if config.search is not None:
        parts.append(search_name(config.search))
    if avatar.facts.get("data", config.data.name) != config.data.name:
        parts.append(config.data.name)
    if avatar.facts.get("subject", config.subject) != config.subject:
        parts.append(config.subject)
    if config.max_frames is not None or config.points is not None:
        parts.append("part")
    return "_".join(parts)


def _check_writable(folder: Path) -> None:
    """Check before the work that the results can be written."""
    existing = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise UserError(f"cannot write results to {folder}: {existing} is not a writable folder; copy the run folder")
