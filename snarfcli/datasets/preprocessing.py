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

from snarfcli.datasets.store import samples_folder
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
from snarfcli.sampling import SamplingSettings, check_mesh, run_in_processes, sample_frames

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


def preprocess_subject(
    subject: SubjectData,
    root: str | Path,
    sampling: SamplingSettings,
    frame_steps: Mapping[str, int],
    *,
    workers: int = 1,
    overwrite: bool = False,
    sequences: Sequence[str] = (),
) -> dict[str, Any]:
    """Make the samples of one subject, or those that are still missing, and return the manifest.

    Args:
        subject: body, shape and motions.
        root: the data folder; the samples go under `processed/{data}/{subject}`.
        sampling: how points are chosen and labelled.
        frame_steps: for each split, every how many frames of the motion one is taken.
        workers: number of processes.
        overwrite: discard the samples that are there.
        sequences: names of the sequences to make, all if empty.

    Raises:
        UserError: the samples there were made with other settings or from other motion, a sequence is unknown, a mesh
            cannot be labelled, or another process works in the same folder.
        OSError: the disk is full or cannot be written to. Sequences that were complete stay; nothing half-made does.
    """
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
            faces, boundary_edges = _write_subject(folder, subject, sampling.inside_test)
            done = _complete_sequences(folder, subject, settings, frame_steps)
            missing = [spec for spec in chosen if (spec.split, spec.name) not in done]
            if len(missing) < len(chosen):
                log.info("%d of %d sequences are there already", len(chosen) - len(missing), len(chosen))
            made = _make_sequences(folder, subject, missing, faces, boundary_edges == 0, sampling, settings, workers)
            done.update({(entry["split"], entry["name"]): entry for entry in made})
            seconds = time.monotonic() - started
            entries = [done[spec.split, spec.name] for spec in subject.sequences if (spec.split, spec.name) in done]
            header = {
                "made_by": "snarf preprocess",
                "data": subject.data,
                "subject": subject.subject,
                "settings": settings,
                "versions": _versions(),
                "boundary_edges": boundary_edges,
            }
            manifest = write_manifest(folder, header, entries)
        except BaseException as error:
            remove_leftovers(folder)
            if isinstance(error, OSError) and error.errno is not None and error.filename is None:
                error.filename = str(folder)  # a write to a full disk does not say where
            raise
    _report(manifest, sum(entry["frames"] for entry in made), sampling.points_per_frame, seconds)
    return manifest


def _choose(subject: SubjectData, names: Sequence[str]) -> list[SequenceSpec]:
    known = [spec.name for spec in subject.sequences]
    for name in names:
        if name not in known:
            raise UserError(f"subject {subject.subject} has no sequence '{name}'{nearest(name, known)}")
    return [spec for spec in subject.sequences if not names or spec.name in names]


def _write_subject(folder: Path, subject: SubjectData, inside_test: str) -> tuple[np.ndarray, int]:
    """Write `subject.npz`, or check that the one there is of the same body; return faces and boundary edges."""
    body, skeleton = subject.body.to(torch.float64), subject.skeleton.to(torch.float64)
    canonical = body.pose(skeleton.canonical_pose[None], subject.betas).vertices[0].numpy()
    faces = body.faces.numpy().astype(np.int32)
    boundary_edges = check_mesh(canonical, faces, inside_test, f"the mesh of subject {subject.subject}")
    if boundary_edges:
        log.warning(
            "the mesh of subject %s is open, %d boundary edges: labelled by winding number, inside is above a half",
            subject.subject,
            boundary_edges,
        )
    arrays = {
        "names": np.array(skeleton.names),
        "parents": np.array(skeleton.parents, np.int32),
        "joints_rest": skeleton.joints_rest.numpy().astype(np.float32),
        "canonical_pose": skeleton.canonical_pose.numpy().astype(np.float32),
        "faces": faces,
        "vertices_canonical": canonical.astype(np.float32),
        "vertex_weights": body.weights.numpy().astype(np.float32),
        "betas": np.asarray(subject.betas, np.float32),
    }
    path = folder / "subject.npz"
    if not path.exists():
        write_arrays(path, arrays)
        return faces, boundary_edges
    there = read_npz(path, "samples")
    for name, array in arrays.items():
        same = name in there and there[name].shape == array.shape
        if same and array.dtype.kind == "f":
            same = np.allclose(there[name], array, rtol=0.0, atol=_POSE_TOLERANCE)
        elif same:
            same = np.array_equal(there[name], array)
        if not same:
            raise UserError(
                f"the samples in {folder} were made from another body ({name} differs); start again with overwrite=true"
            )
    return faces, boundary_edges


def _complete_sequences(
    folder: Path, subject: SubjectData, settings: Mapping[str, Any], frame_steps: Mapping[str, int]
) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the descriptions of the sequences that need not be made again, by split and name."""
    done = {}
    for spec in subject.sequences:
        place = folder / spec.split / spec.name
        if not (place / "sequence.json").exists():
            continue
        entry = read_json(place / "sequence.json", "samples")
        sizes = {name: (place / name).stat().st_size if (place / name).exists() else None for name in entry["files"]}
        if entry["settings_digest"] != settings_digest(settings) or any(
            sizes[name] != described["bytes"] for name, described in entry["files"].items()
        ):
            log.warning("%s/%s is damaged and is made again", spec.split, spec.name)
            continue
        there = read_npz(place / "frames.npz", "samples")
        frames = _frame_numbers(spec, frame_steps)
        wanted = {"poses": spec.motion.poses[frames], "translation": spec.motion.translation[frames]}
        for name, array in wanted.items():
            if there[name].shape != array.shape or not np.allclose(there[name], array, rtol=0.0, atol=_POSE_TOLERANCE):
                raise UserError(f"{place} was made from another motion ({name} differs); start again with overwrite=true")
        done[spec.split, spec.name] = entry
    return done


def _frame_numbers(spec: SequenceSpec, frame_steps: Mapping[str, int]) -> np.ndarray:
    return np.arange(0, spec.motion.num_frames, frame_steps[spec.split])


def _pose_frames(subject: SubjectData, spec: SequenceSpec, frames: np.ndarray) -> dict[str, np.ndarray]:
    """Pose the mesh in the chosen frames and return what `frames.npz` holds: float32, metres and radians."""
    body, skeleton = subject.body.to(torch.float64), subject.skeleton.to(torch.float64)
    pose = torch.from_numpy(spec.motion.poses[frames])
    translation = torch.from_numpy(spec.motion.translation[frames])
    posed = [
        body.pose(pose[i : i + 1], subject.betas, translation[i : i + 1])
        for i in range(len(frames))  # one at a time: the pose correctives of many are large
    ]
    vertices = torch.cat([one.vertices for one in posed]).numpy().astype(np.float32)
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=(1, 2)))
    if len(bad):
        raise UserError(f"{spec.name} has NaN or infinite vertices in frame {frames[bad[0]]}; repair its poses first")
    return {
        "poses": pose.numpy().astype(np.float32),
        "translation": translation.numpy().astype(np.float32),
        "posed_from_canonical": skeleton.posed_from_canonical(pose, translation).numpy().astype(np.float32),
        "joints": torch.cat([one.joints for one in posed]).numpy().astype(np.float32),
        "vertices": vertices,
        "box_lower": vertices.min(axis=1),
        "box_upper": vertices.max(axis=1),
        "frame_numbers": frames,
    }


def _make_sequences(
    folder: Path,
    subject: SubjectData,
    specs: Sequence[SequenceSpec],
    faces: np.ndarray,
    is_closed: bool,
    sampling: SamplingSettings,
    settings: Mapping[str, Any],
    workers: int,
) -> list[dict[str, Any]]:
    """Sample and write sequences; each appears when its last frame is in. Return their descriptions."""
    steps = {split: settings[f"{split}_frame_step"] for split in ("train", "test", "ood")}
    jobs: list[_Job] = []
    places: list[tuple[_Job, int]] = []  # of each task: its sequence, and the next frame that it will send

    def tasks() -> Iterator[tuple[Any, ...]]:
        for spec in specs:
            frames = _frame_numbers(spec, steps)
            arrays = _pose_frames(subject, spec, frames)
            writer = SequenceWriter(folder / spec.split / spec.name, len(frames), sampling.points_per_frame)
            jobs.append(_Job(spec, arrays, writer, len(frames)))
            for start in range(0, len(frames), _FRAMES_PER_TASK):
                places.append((jobs[-1], start))
                part = slice(start, start + _FRAMES_PER_TASK)
                names = (subject.subject, spec.name)
                yield arrays["vertices"][part], faces, sampling, names, frames[part], is_closed

    made = []
    total = sum(len(_frame_numbers(spec, steps)) for spec in specs)
    results = run_in_processes(sample_frames, tasks(), workers)
    try:
        for task, samples in progress(results, total=total, desc=f"preprocess {subject.subject}", unit="frames"):
            job, frame = places[task]
            places[task] = (job, frame + 1)
            job.writer.write_frame(frame, samples)
            job.frames_left -= 1
            if job.frames_left == 0:
                description = {
                    "name": job.spec.name,
                    "split": job.spec.split,
                    "frame_rate": job.spec.motion.frame_rate,
                    "settings": settings,
                }
                made.append(job.writer.finish(job.arrays, description))
                job.arrays = {}
                log.info(
                    "%s/%s: %d frames, %.2f %% of the points inside, %.3f %% self-intersecting",
                    job.spec.split, job.spec.name, made[-1]["frames"],
                    100 * made[-1]["inside_share"], 100 * made[-1]["self_intersecting_share"],
                )  # fmt: skip
    finally:
        results.close()
        for job in jobs:
            job.writer.discard()
    return made


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
            "%d frames, %d samples in %.1f s: %.0f samples/s",
            frames, frames * points_per_frame, seconds, frames * points_per_frame / seconds,
        )  # fmt: skip
    log.info(
        "subject %s of %s data: %d train, %d test, %d ood frames, %.1f MB on disk, %.0f bytes a frame",
        manifest["subject"], manifest["data"], counts["train"], counts["test"], counts["ood"],
        manifest["bytes"] / 1e6, manifest["bytes"] / max(1, all_frames),
    )  # fmt: skip
    if manifest["boundary_edges"] == 0:
        log.info(
            "self-intersecting: winding number and ray parity label %.3f %% of the points differently",
            100 * manifest["self_intersecting_share"],
        )
