"""From a subject's motions to its store of samples: pose the meshes, sample them on several processes, write and resume."""

from __future__ import annotations

import importlib.metadata
import logging
import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from snarfcli.bodies import Skeleton, invert_rigid
from snarfcli.datasets.store import SEQUENCE_FILES, samples_folder
from snarfcli.datasets.subjects import SequenceSpec, SubjectData
from snarfcli.datasets.writing import (
    SequenceWriter,
    discard_samples,
    hold_folder,
    refuse_other_settings,
    remove_leftovers,
    settings_digest,
    write_arrays,
    write_manifest,
)
from snarfcli.errors import UserError, nearest
from snarfcli.files import read_json, read_npz
from snarfcli.progress import progress
from snarfcli.sampling import BrokenFrame, SamplingSettings, check_mesh, run_in_processes, sample_frames

__all__ = ["preprocess_subject"]

log = logging.getLogger(__name__)

_FRAMES_PER_TASK = 30  # 3 to 4 s of work for 0.4 s of starting a process; the samples depend on it, see sampling/parallel
_POSE_TOLERANCE = 1e-4  # radians and metres; the same motion on another machine differs by rounding only
_PACKAGES = ("snarf", "numpy", "torch", "libigl", "pymeshlab", "trimesh", "embreex")


@dataclass
class _Job:
    """One sequence that is being made."""

    spec: SequenceSpec
    arrays: dict[str, np.ndarray]
    writer: SequenceWriter
    frames_left: int
    is_broken: bool = False


def preprocess_subject(
    subject: SubjectData,
    root: str | Path,
    sampling: SamplingSettings,
    frame_steps: Mapping[str, int],
    *,
    workers: int = 1,
    overwrite: bool = False,
    sequences: Sequence[str] = (),
    skip_broken: bool = False,
) -> dict[str, Any]:
    """Make the samples of one subject, or those that are still missing, and return the manifest.

    Args:
        subject: skeleton and sequences.
        root: the data folder; the samples go under `processed/{data}/{subject}`.
        sampling: how points are chosen and labelled.
        frame_steps: for each split, every how many frames of the motion one is taken.
        workers: number of processes.
        overwrite: discard the samples that are there.
        sequences: names of the sequences to make, all if empty.
        skip_broken: leave out sequences that cannot be used, and say so, instead of stopping.

    Raises:
        UserError: the samples there were made with other settings or from other motion, a sequence is unknown or cannot be
            used, or another process works in the same folder.
        OSError: the disk is full or cannot be written to. Sequences that were complete stay; nothing half-made does.
    """
    broken = _report_broken(subject, sequences, skip_broken)
    chosen = _choose(subject, sequences)
    settings = {
        "data": subject.data,
        "subject": subject.subject,
        **vars(sampling),
        **{f"{split}_frame_step": step for split, step in frame_steps.items()},
    }
    folder = samples_folder(root, subject.data, subject.subject)
    with hold_folder(folder):
        try:
            remove_leftovers(folder)
            if overwrite:
                discard_samples(folder)
            refuse_other_settings(folder, settings)
            started = time.monotonic()
            _write_subject(folder, subject, sampling.inside_test)
            done = _complete_sequences(folder, subject, settings, frame_steps)
            missing = [spec for spec in chosen if (spec.split, spec.name) not in done]
            if len(missing) < len(chosen):
                log.info("%d of %d sequences are there already", len(chosen) - len(missing), len(chosen))
            made = _make_sequences(folder, subject, missing, sampling, settings, workers, broken if skip_broken else None)
            done.update({(entry["split"], entry["name"]): entry for entry in made})
            if not done:
                raise UserError(f"subject {subject.subject} of {subject.data} data has no sequence that can be used")
            seconds = time.monotonic() - started
            entries = [done[spec.split, spec.name] for spec in subject.sequences if (spec.split, spec.name) in done]
            header = {
                "made_by": "snarf preprocess",
                "data": subject.data,
                "subject": subject.subject,
                "sources": list(subject.sources),
                "skipped": [{"name": name, "reason": reason} for name, reason in broken],
                "settings": settings,
                "versions": _versions(),
            }
            manifest = write_manifest(folder, header, entries)
        except BaseException as error:
            remove_leftovers(folder)
            if isinstance(error, OSError) and error.errno is not None and error.filename is None:
                error.filename = str(folder)  # a write to a full disk does not say where
            raise
    _report(manifest, sum(entry["frames"] for entry in made), sampling.points_per_frame, seconds)
    return manifest


def _report_broken(subject: SubjectData, names: Sequence[str], skip_broken: bool) -> list[tuple[str, str]]:
    """Return the sequences that the data set could not read, among those asked for; refuse them unless they may be left out."""
    broken = [(name, reason) for name, reason in subject.broken if not names or name in names]
    if broken and not skip_broken:
        name, reason = broken[0]
        more = f" ({len(broken) - 1} more like it)" if len(broken) > 1 else ""
        raise UserError(f"sequence {name} cannot be used: {reason}{more}; give skip_broken=true to leave such sequences out")
    for name, reason in broken:
        log.warning("left out: sequence %s (%s)", name, reason)
    return broken


def _choose(subject: SubjectData, names: Sequence[str]) -> list[SequenceSpec]:
    known = [spec.name for spec in subject.sequences]
    for name in names:
        if name not in known and name not in (broken for broken, _ in subject.broken):
            raise UserError(f"subject {subject.subject} has no sequence '{name}'{nearest(name, known)}")
    return [spec for spec in subject.sequences if not names or spec.name in names]


def _write_subject(folder: Path, subject: SubjectData, inside_test: str) -> None:
    """Write `subject.npz`, or check that the one there is of the same subject."""
    skeleton, template = subject.skeleton, subject.template
    arrays = {
        "names": np.array(skeleton.names),
        "parents": np.array(skeleton.parents, np.int32),
        "joints_rest": skeleton.joints_rest.numpy().astype(np.float32),
        "canonical_pose": skeleton.canonical_pose.numpy().astype(np.float32),
        "betas": np.asarray(subject.betas, np.float32),
    }
    if template is not None:
        boundary_edges = check_mesh(template.vertices, template.faces, inside_test, f"the mesh of subject {subject.subject}")
        if boundary_edges:
            log.warning(
                "the mesh of subject %s is open, %d boundary edges: labelled by winding number, inside is above a half",
                subject.subject, boundary_edges,
            )  # fmt: skip
        arrays |= {
            "faces": template.faces.astype(np.int32),
            "vertices_canonical": template.vertices.astype(np.float32),
            "vertex_weights": template.weights.astype(np.float32),
        }
    path = folder / "subject.npz"
    if not path.exists():
        write_arrays(path, arrays)
        return
    try:
        there = read_npz(path, "samples")
    except UserError:
        raise UserError(f"the samples are damaged: {path} cannot be read; start again with overwrite=true") from None
    for name in sorted(arrays.keys() | there.keys()):
        same = name in arrays and name in there and there[name].shape == arrays[name].shape
        if same and arrays[name].dtype.kind == "f":
            same = np.allclose(there[name], arrays[name], rtol=0.0, atol=_POSE_TOLERANCE)
        elif same:
            same = np.array_equal(there[name], arrays[name])
        if not same:
            raise UserError(
                f"the samples in {folder} were made from another body ({name} differs); start again with overwrite=true"
            )


def _complete_sequences(
    folder: Path, subject: SubjectData, settings: Mapping[str, Any], frame_steps: Mapping[str, int]
) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the descriptions of the sequences that need not be made again, by split and name."""
    done = {}
    for spec in subject.sequences:
        place = folder / spec.split / spec.name
        if not (place / "sequence.json").exists():
            continue
        try:
            entry = read_json(place / "sequence.json", "samples")
            sizes = {name: entry["files"][name]["bytes"] for name in SEQUENCE_FILES}
            is_whole = entry["settings_digest"] == settings_digest(settings)
            is_whole &= all((place / name).is_file() and (place / name).stat().st_size == size for name, size in sizes.items())
            there = read_npz(place / "frames.npz", "samples") if is_whole else {}
        except (UserError, KeyError, TypeError):
            is_whole = False
        frames = _frame_numbers(spec, frame_steps)
        wanted = _frame_arrays(subject.skeleton, spec, frames)
        if not is_whole or not wanted.keys() <= there.keys():
            log.warning("%s/%s is damaged and is made again", spec.split, spec.name)
            continue
        differs = [
            name
            for name, array in wanted.items()
            if there[name].shape != array.shape or not np.allclose(there[name], array, rtol=0.0, atol=_POSE_TOLERANCE)
        ]
        if not differs and entry.get("source") != spec.meshes.fingerprint():
            raise UserError(f"{place} was made from other meshes (the files have changed); start again with overwrite=true")
        if differs:
            raise UserError(f"{place} was made from another motion ({differs[0]} differs); start again with overwrite=true")
        done[spec.split, spec.name] = entry
    return done


def _frame_numbers(spec: SequenceSpec, frame_steps: Mapping[str, int]) -> np.ndarray:
    """Return the numbers of the frames to sample."""
    if spec.frames is not None:
        return np.asarray(spec.frames, np.int64)
    return np.arange(0, spec.motion.num_frames, frame_steps[spec.split])


def _frame_arrays(skeleton: Skeleton, spec: SequenceSpec, frames: np.ndarray) -> dict[str, np.ndarray]:
    """Return what `frames.npz` says about the chosen frames: float32, metres and radians."""
    skeleton = skeleton.to(torch.float64)
    pose = torch.from_numpy(spec.motion.poses[frames])
    translation = torch.from_numpy(spec.motion.translation[frames])
    if spec.posed_from_rest is None:
        posed_from_rest = skeleton.posed_from_rest(pose, translation)
    else:
        posed_from_rest = torch.from_numpy(spec.posed_from_rest[frames])
    canonical_from_rest = skeleton.posed_from_rest(skeleton.canonical_pose[None])
    joints = torch.einsum("tjrc,jc->tjr", posed_from_rest[..., :3, :3], skeleton.joints_rest) + posed_from_rest[..., :3, 3]
    arrays = {
        "poses": pose,
        "translation": translation,
        "posed_from_canonical": posed_from_rest @ invert_rigid(canonical_from_rest),
        "joints": joints,
    }
    for name, array in arrays.items():
        bad = np.flatnonzero(~array.isfinite().flatten(1).all(1).numpy())
        if len(bad):
            raise UserError(f"{spec.name} has NaN or infinite {name} in frame {frames[bad[0]]}; repair its poses first")
    return {name: array.numpy().astype(np.float32) for name, array in arrays.items()} | {"frame_numbers": frames}


def _make_sequences(
    folder: Path,
    subject: SubjectData,
    specs: Sequence[SequenceSpec],
    sampling: SamplingSettings,
    settings: Mapping[str, Any],
    workers: int,
    broken: list[tuple[str, str]] | None,
) -> list[dict[str, Any]]:
    """Sample and write sequences; each appears when its last frame is in. Return their descriptions.

    One that turns out to be unusable is added to `broken`, or is an error if that is None.
    """
    steps = {split: settings[f"{split}_frame_step"] for split in ("train", "test", "ood")}
    jobs: list[_Job] = []
    places: list[tuple[_Job, int]] = []  # of each task: its sequence, and the next frame that it will send

    def tasks() -> Iterator[tuple[Any, ...]]:
        for spec in specs:
            frames = _frame_numbers(spec, steps)
            arrays = _frame_arrays(subject.skeleton, spec, frames)
            writer = SequenceWriter(folder / spec.split / spec.name, len(frames), sampling.points_per_frame)
            job = _Job(spec, arrays, writer, len(frames))
            jobs.append(job)
            for start in range(0, len(frames), _FRAMES_PER_TASK):
                if job.is_broken:
                    break
                places.append((job, start))
                part = frames[start : start + _FRAMES_PER_TASK]
                yield spec.meshes.chosen(part), sampling, (subject.subject, spec.name), part

    made = []
    total = sum(len(_frame_numbers(spec, steps)) for spec in specs)
    results = run_in_processes(sample_frames, tasks(), workers)
    try:
        for task, samples in progress(results, total=total, desc=f"preprocess {subject.subject}", unit="frames"):
            job, frame = places[task]
            places[task] = (job, frame + 1)
            if isinstance(samples, BrokenFrame):
                if broken is None:
                    raise UserError(f"{samples.message}; give skip_broken=true to leave such sequences out")
                if not job.is_broken:
                    log.warning("left out: sequence %s (%s)", job.spec.name, samples.message)
                    broken.append((job.spec.name, samples.message))
                    job.is_broken = True
                    job.writer.discard()
            if job.is_broken:
                continue
            job.writer.write_frame(frame, samples)
            job.frames_left -= 1
            if job.frames_left == 0:
                description = {
                    "name": job.spec.name,
                    "split": job.spec.split,
                    "frame_rate": job.spec.motion.frame_rate,
                    "source": job.spec.meshes.fingerprint(),
                    "settings": settings,
                }
                made.append(job.writer.finish(job.arrays, description))
                job.arrays = {}
                _report_sequence(made[-1])
    finally:
        results.close()
        for job in jobs:
            job.writer.discard()
    return made


def _report_sequence(entry: Mapping[str, Any]) -> None:
    open_mesh = f", open meshes (up to {entry['boundary_edges']} boundary edges)" if entry["boundary_edges"] else ""
    log.info(
        "%s/%s: %d frames, %.2f %% of the points inside, %.3f %% self-intersecting%s",
        entry["split"], entry["name"], entry["frames"],
        100 * entry["inside_share"], 100 * entry["self_intersecting_share"], open_mesh,
    )  # fmt: skip
    if entry["inside_share"] == 0:
        log.warning("warning: no point of %s is inside; are its meshes surfaces of a body, with faces outward?", entry["name"])


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def _report(manifest: Mapping[str, Any], frames: int, points_per_frame: int, seconds: float) -> None:
    counts = manifest["frames"]
    all_frames = sum(counts.values())
    if frames:
        log.info(
            "%d frames, %d samples in %.1f s: %.1f frames/s, %.0f samples/s",
            frames, frames * points_per_frame, seconds, frames / seconds, frames * points_per_frame / seconds,
        )  # fmt: skip
    log.info(
        "subject %s of %s data: %d train, %d test, %d ood frames, %.1f MB on disk, %.0f bytes a frame",
        manifest["subject"], manifest["data"], counts["train"], counts["test"], counts["ood"],
        manifest["bytes"] / 1e6, manifest["bytes"] / max(1, all_frames),
    )  # fmt: skip
    if all(entry["boundary_edges"] == 0 for entry in manifest["sequences"]):
        log.info(
            "self-intersecting: winding number and ray parity label %.3f %% of the points differently",
            100 * manifest["self_intersecting_share"],
        )
