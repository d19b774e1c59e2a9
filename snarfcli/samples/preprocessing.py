"""Preprocess a subject: pose its meshes, sample them in several processes, and write the samples; can be resumed."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.datasets.splits import SPLITS
from snarfcli.datasets.subjects import SequenceSpec, SubjectData
from snarfcli.errors import UserError, nearest
from snarfcli.output_locks import hold_output
from snarfcli.parallel import run_in_processes
from snarfcli.progress import progress
from snarfcli.samples.finished import complete_sequences, write_subject
from snarfcli.samples.frames import frame_arrays, frame_numbers
from snarfcli.samples.layout import samples_folder
from snarfcli.samples.writing import (
    SequenceWriter,
    discard_samples,
    remove_leftovers,
    require_same_settings,
    write_manifest,
)
from snarfcli.sampling import BrokenFrame, SamplingSettings, check_frames, recorded_settings, sample_frames
from snarfcli.texts import counted
from snarfcli.versions import recorded_versions

__all__ = ["preprocess_subject"]

log = logging.getLogger(__name__)

_FRAMES_PER_TASK = 30  # 3 to 4 s of work per 0.4 s to start a process; the samples depend on it, see snarfcli/parallel.py
_FRAMES_PER_CHECK = 200  # per process that only reads


@dataclass
class _Job:
    """A sequence in progress."""

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
    wait: bool = False,
    sequences: Sequence[str] = (),
    skip_broken: bool = False,
) -> dict[str, Any]:
    """Make the missing samples of one subject, and return the manifest.

    Args:
        subject: skeleton and sequences.
        root: the data folder; the samples go under `processed/{data}/{subject}`.
        sampling: settings of the points and their labels.
        frame_steps: per split, the step between sampled frames of a motion.
        workers: number of processes.
        overwrite: delete existing samples first.
        wait: wait while another process makes samples of the subject, instead of raising.
        sequences: names of the sequences to make; all if empty.
        skip_broken: leave out sequences that cannot be used, with a warning, instead of raising.

    Raises:
        UserError: existing samples were made with other settings or from other motion, a sequence is unknown or cannot be
            used, or another process is working in the same folder.
        OSError: the disk is full or cannot be written to. Complete sequences are kept, partial ones are deleted.
    """
    broken = _report_broken(subject, sequences, skip_broken)
    chosen = _choose(subject, sequences)
    sampling = replace(sampling, is_planar=subject.is_planar)
    settings = {
        "data": subject.data,
        "subject": subject.subject,
        **recorded_settings(sampling),
        **{f"{split}_frame_step": step for split, step in frame_steps.items()},
    }
    folder = samples_folder(root, subject.data, subject.subject)
    with hold_output(folder, "snarf preprocess", wait=wait):
        try:
            remove_leftovers(folder)
            new = [spec for spec in chosen if overwrite or not (folder / spec.split / spec.name / "sequence.json").exists()]
            unusable = _check_files(subject, new, frame_steps, sampling.inside_test, workers, skip_broken)
            broken += unusable
            chosen = [spec for spec in chosen if spec.name not in dict(unusable)]
            if overwrite:
                discard_samples(folder)
            require_same_settings(folder, settings)
            started = time.monotonic()
            write_subject(folder, subject, sampling.inside_test)
            done = complete_sequences(folder, subject, settings, frame_steps)
            missing = [spec for spec in chosen if (spec.split, spec.name) not in done]
            if len(missing) < len(chosen):
                log.info("%d of %s existed already", len(chosen) - len(missing), counted(len(chosen), "sequence"))
            made = _make_sequences(folder, subject, missing, sampling, settings, workers, broken if skip_broken else None)
            done.update({(entry["split"], entry["name"]): entry for entry in made})
            if not done:
                raise UserError(f"subject {subject.subject} of {subject.data} data has no usable sequence; name others")
            seconds = time.monotonic() - started
            entries = [done[spec.split, spec.name] for spec in subject.sequences if (spec.split, spec.name) in done]
            header = {
                "made_by": "snarf preprocess",
                "data": subject.data,
                "subject": subject.subject,
                "sources": list(subject.sources),
                "skipped": [{"name": name, "reason": reason} for name, reason in dict([*subject.broken, *broken]).items()],
                "settings": settings,
                "versions": recorded_versions(),
            }
            manifest = write_manifest(folder, header, entries)
        except BaseException as error:
            remove_leftovers(folder)
            if isinstance(error, OSError) and error.errno is not None and error.filename is None:
                error.filename = str(folder)  # a write to a full disk does not name the file
            raise
    _report(manifest, sum(entry["frames"] for entry in made), sampling.points_per_frame, seconds)
    return manifest


def _report_broken(subject: SubjectData, names: Sequence[str], skip_broken: bool) -> list[tuple[str, str]]:
    """Return the requested sequences that the data set could not read; raise UserError if they may not be left out."""
    broken = [(name, reason) for name, reason in subject.broken if not names or name in names]
    if broken and not skip_broken:
        name, reason = broken[0]
        more = f" (and {len(broken) - 1} more)" if len(broken) > 1 else ""
        raise UserError(f"sequence {name} cannot be used: {reason}{more}; give skip_broken=true to leave such sequences out")
    for name, reason in broken:
        log.warning("left out: sequence %s (%s)", name, reason)
    return broken


def _check_files(
    subject: SubjectData,
    specs: Sequence[SequenceSpec],
    frame_steps: Mapping[str, int],
    inside_test: str,
    workers: int,
    skip_broken: bool,
) -> list[tuple[str, str]]:
    """Read every mesh file once before other work, and return the sequences that cannot be used, with the reason.

    Raises:
        UserError: there is one, and it may not be left out.
    """
    frames = {spec.name: frame_numbers(spec, frame_steps) for spec in specs if spec.meshes.source(0)}
    parts = [
        (spec, frames[spec.name][start : start + _FRAMES_PER_CHECK])
        for spec in specs
        for start in range(0, len(frames.get(spec.name, ())), _FRAMES_PER_CHECK)
    ]
    if not parts:
        return []
    broken: dict[str, str] = {}
    results = run_in_processes(
        check_frames, ((spec.meshes.chosen(part), inside_test, spec.name, part) for spec, part in parts), workers
    )
    total = sum(len(part) for _, part in parts)
    try:
        for task, problem in progress(results, total=total, desc=f"checking {subject.subject}", unit="meshes"):
            name = parts[task][0].name
            if problem is None or name in broken:
                continue
            if not skip_broken:
                raise UserError(f"{problem.message}; give skip_broken=true to leave such sequences out")
            log.warning("left out: sequence %s (%s)", name, problem.message)
            broken[name] = problem.message
    finally:
        results.close()
    return list(broken.items())


def _choose(subject: SubjectData, names: Sequence[str]) -> list[SequenceSpec]:
    known = [spec.name for spec in subject.sequences]
    for name in names:
        if name not in known and name not in (broken for broken, _ in subject.broken):
            raise UserError(f"subject {subject.subject} has no sequence '{name}'{nearest(name, known)}")
    return [spec for spec in subject.sequences if not names or spec.name in names]


def _make_sequences(
    folder: Path,
    subject: SubjectData,
    specs: Sequence[SequenceSpec],
    sampling: SamplingSettings,
    settings: Mapping[str, Any],
    workers: int,
    broken: list[tuple[str, str]] | None,
) -> list[dict[str, Any]]:
    """Sample and write sequences, and return their descriptions.

    Sequences that cannot be used are added to `broken`; if that is None, they raise UserError.
    """
    steps = {split: settings[f"{split}_frame_step"] for split in SPLITS}
    jobs: list[_Job] = []
    places: list[tuple[_Job, int]] = []  # per task: its sequence, and the next frame that it returns

    def tasks() -> Iterator[tuple[Any, ...]]:
        for spec in specs:
            frames = frame_numbers(spec, steps)
            arrays = frame_arrays(subject.skeleton, spec, frames)
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
    total = sum(len(frame_numbers(spec, steps)) for spec in specs)
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
            assert not isinstance(samples, BrokenFrame)
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
        "%s/%s: %s, %.2f %% of the points inside, %.3f %% self-intersecting%s",
        entry["split"], entry["name"], counted(entry["frames"], "frame"),
        100 * entry["inside_share"], 100 * entry["self_intersecting_share"], open_mesh,
    )  # fmt: skip
    if entry["inside_share"] == 0:
        log.warning(
            "warning: no point of %s is inside; check that its meshes are surfaces of a body, with faces outward", entry["name"]
        )


def _report(manifest: Mapping[str, Any], frames: int, points_per_frame: int, seconds: float) -> None:
    counts = manifest["frames"]
    all_frames = sum(counts.values())
    if frames:
        log.info(
            "%s, %d samples in %.1f s: %.1f frames/s, %.0f samples/s",
            counted(frames, "frame"), frames * points_per_frame, seconds, frames / seconds, frames * points_per_frame / seconds,
        )  # fmt: skip
    log.info(
        "subject %s of %s data: %d train, %d test, %d ood frames, %.1f MB on disk, %.0f bytes per frame",
        manifest["subject"], manifest["data"], counts["train"], counts["test"], counts["ood"],
        manifest["bytes"] / 1e6, manifest["bytes"] / max(1, all_frames),
    )  # fmt: skip
    if counts["train"] and not counts["test"] and not counts["ood"]:
        log.warning("warning: no sequence is held out, so nothing can be evaluated; name some with data.test=[NAME]")
    if all(entry["boundary_edges"] == 0 for entry in manifest["sequences"]):
        log.info(
            "self-intersecting: winding number and ray parity give different labels to %.3f %% of the points",
            100 * manifest["self_intersecting_share"],
        )
