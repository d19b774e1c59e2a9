"""Fit a body to all scans of a subject: what the files are like, one shape, the poses of every sequence; can be resumed."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.datasets.sources import Request
from snarfcli.errors import UserError
from snarfcli.files import remove_temporaries
from snarfcli.output_locks import hold_output
from snarfcli.parallel import run_in_processes
from snarfcli.progress import progress
from snarfcli.registration.tracker import FittedSequence
from snarfcli.scanned_subjects.fit_figure import write_fit_figure
from snarfcli.scanned_subjects.fit_options import FitOptions
from snarfcli.scanned_subjects.fit_report import FIGURE, REPORT, SequenceReport, write_fit_report
from snarfcli.scanned_subjects.fit_workers import SequenceTask, fit_sequences
from snarfcli.scanned_subjects.fitter import Fitter, RigFitter, load_fitter
from snarfcli.scanned_subjects.scan_files import ScanFacts, fingerprint
from snarfcli.scanned_subjects.scans import ScanFolder, find_scans
from snarfcli.scanned_subjects.subject_scans import SubjectScans, read_subject
from snarfcli.scanned_subjects.subject_shape import decide_shape, resized, rig_size
from snarfcli.scanned_subjects.written import (
    LONGEST_REASON,
    FitMade,
    FittedFile,
    foreign_files,
    own_poses,
    read_fitted,
    read_made,
    remove_replaced,
    write_fitted,
    write_skeleton,
)
from snarfcli.texts import counted, one_line

__all__ = ["fit_subject"]

log = logging.getLogger(__name__)

_FRAMES_PER_TASK = 60  # of short sequences that share a process, which takes some seconds to start


def fit_subject(subject: str, request: Request, options: FitOptions) -> bool:
    """Fit the missing sequences of one subject, write the files beside its scans, and report them.

    Args:
        subject: name of the subject.
        request: the data set and its folders.
        options: settings.

    Returns:
        Whether all sequences have poses; those of which no scan can be read have none.

    Raises:
        UserError: the subject has no scans, they cannot be used, they show no person, there are skeletons or poses of others,
            earlier poses have other settings, or another process is working on the subject.
        OSError: a file cannot be written. Finished sequences are kept.
    """
    place, folders = find_scans(subject, request)
    with hold_output(place, "snarf fit", wait=options.wait):
        try:
            return _fit(subject, place, folders, options)
        except KeyboardInterrupt:
            log.info("finished sequences are kept; run the same command to continue")
            raise
        except OSError as error:
            if error.errno is not None and error.filename is None:
                error.filename = str(place)  # a write to a full disk does not name the file
            raise
        finally:
            for folder in {place, *(folder.folder for folder in folders)}:
                remove_temporaries(folder)  # of this command, or of a killed one


def _fit(subject: str, place: Path, folders: Sequence[ScanFolder], options: FitOptions) -> bool:
    """Do all the work, while the lock of the folder is held."""
    _check_others(place, folders, options)
    made = None if options.overwrite else read_made(place)
    fitter = load_fitter(options.body)
    settings = options.recorded() | {"body_digest": fitter.digest}
    if made is not None:
        _require_same(place, made, settings)
        made = made if len(made.betas) == fitter.surface.num_betas else None  # a damaged file
    frames = counted(sum(len(folder.paths) for folder in folders), "frame")
    log.info("subject %s: %s, %s; %s", subject, counted(len(folders), "sequence"), frames, fitter.source)
    if not fitter.surface.num_betas:
        log.warning("warning: the body has no shape parameters, so it keeps its own shape")
    scans = read_subject(subject, folders, options, fitter, None if made is None else made.world)
    for line in scans.survey.facts:
        log.info("%s", line)
    if isinstance(fitter, RigFitter):
        scans = resized(scans, rig_size(scans, fitter) if made is None else made.size)
        fitter = load_fitter(scans.options.body)
    if made is None:
        made = decide_shape(subject, scans, fitter, settings)
        for path in (place / REPORT, place / FIGURE, *own_poses([folder.folder for folder in folders])):
            path.unlink(missing_ok=True)  # of an earlier fit, whose poses are not those of the new skeleton
        write_skeleton(place, fitter.skeleton(made.betas), made)
        remove_replaced(place, [])
    header = {"subject": subject, "body": fitter.source, "settings": settings, "facts": list(scans.survey.facts)}
    reports = _fit_missing(subject, place, scans, fitter, made, header)
    write_fit_figure(place / FIGURE, subject, fitter, made, scans, reports)
    log.info("report: %s, figure: %s", place / REPORT, FIGURE)
    return len(reports) == len(folders)


def _check_others(place: Path, folders: Sequence[ScanFolder], options: FitOptions) -> None:
    """Raise UserError if files of others are in the way."""
    others = foreign_files(place, [folder.folder for folder in folders])
    if options.body.skeleton is not None and Path(options.body.skeleton).absolute() in [path.absolute() for path in others]:
        raise UserError(f"skeleton={options.body.skeleton} would be replaced by the fitted one; keep it outside of {place}")
    if others and not options.overwrite:
        what = f" and {counted(len(others) - 1, 'more file')} were" if others[1:] else " was"
        them = "them" if others[1:] else "it"
        raise UserError(f"{others[0]}{what} not written by snarf fit; move {them}, or give overwrite=true to replace {them}")


def _require_same(place: Path, made: FitMade, settings: dict[str, Any]) -> None:
    """Raise UserError if an earlier fit has other settings."""
    names = [name for name in settings if settings[name] != made.settings.get(name)]
    if "body_digest" not in names:
        names = [name for name in names if name not in ("body", "skeleton")]  # the same file in another place
    if names:
        changes = ", ".join(f"{name} {made.settings.get(name)} -> {settings[name]}" for name in names)
        raise UserError(
            f"the poses in {place} were fitted with other settings ({one_line(changes, 400)}); "
            "keep those settings, or start again with overwrite=true"
        )


def _fit_missing(
    subject: str, place: Path, scans: SubjectScans, fitter: Fitter, made: FitMade, header: dict[str, Any]
) -> list[SequenceReport]:
    """Fit the sequences that have no poses of this fit yet, and return the reports of all."""
    names = fitter.surface.joint_names
    sources = [fingerprint(folder.paths, facts) for folder, facts in zip(scans.folders, scans.facts, strict=True)]
    done, missing = _finished(scans, made, sources, names)
    count = len(done) + len(missing)
    write_fit_report(place / REPORT, header, made, _in_order(done), is_complete=not missing)
    for number, fitted, seconds in _fits(subject, scans, made, missing):
        folder = scans.folders[number]
        whole = _whole(fitted, scans.facts[number], scans.usable(number), sources[number], seconds)
        write_fitted(folder.folder, whole, made, scans.options.frame_rate)
        remove_replaced(place, [folder.folder])
        done[number] = SequenceReport(folder.name, number, whole, names)
        log.info("%s", done[number].line())
        write_fit_report(place / REPORT, header, made, _in_order(done), is_complete=len(done) == count)
    return _in_order(done)


def _finished(
    scans: SubjectScans, made: FitMade, sources: Sequence[str], names: tuple[str, ...]
) -> tuple[dict[int, SequenceReport], list[int]]:
    """Return the reports of the sequences that have poses of this fit, by number, and the numbers of the others.

    Args:
        scans: of the subject.
        made: the fit.
        sources: digests of the scans of each sequence.
        names: of the joints.
    """
    done: dict[int, SequenceReport] = {}
    missing: list[int] = []
    changed: list[str] = []
    for number, folder in enumerate(scans.folders):
        if not scans.usable(number):
            log.warning("left out: sequence %s, of which no frame can be read", folder.name)
            continue
        there = read_fitted(folder.folder, made, len(names))
        if there is not None and (there.source, len(there.poses)) == (sources[number], len(folder.paths)):
            done[number] = SequenceReport(folder.name, number, there, names)
        else:
            missing.append(number)
            changed += [] if there is None else [folder.name]
    if changed:
        log.info(
            "the scans of %s have changed, such as %s, which is fitted again", counted(len(changed), "sequence"), changed[0]
        )
    if changed and not done:
        log.warning("warning: shape and unit are kept from earlier scans; if those were of another person, give overwrite=true")
    if done:
        log.info("%d of %s fitted already", len(done), counted(len(done) + len(missing), "sequence"))
    return done, missing


def _in_order(done: Mapping[int, SequenceReport]) -> list[SequenceReport]:
    return [done[number] for number in sorted(done)]


def _fits(
    subject: str, scans: SubjectScans, made: FitMade, numbers: Sequence[int]
) -> Iterator[tuple[int, FittedSequence, float]]:
    """Yield the number, the poses and the processor time of each sequence, in the order in which they are done."""
    options = scans.options
    groups: list[list[SequenceTask]] = []
    room = 0
    for number in numbers:
        task = SequenceTask(
            number, scans.sequence(number, made.world), options.ordered, has_one_topology=bool(scans.topology(number))
        )
        if room <= 0 or len(groups) < options.workers:
            groups.append([])
            room = _FRAMES_PER_TASK
        groups[-1].append(task)
        room -= len(task.scans)
    total = sum(len(task.scans) for group in groups for task in group)
    results = run_in_processes(
        fit_sequences, ((options.body, made.betas, options.clothes_m, group) for group in groups), options.workers
    )
    ready: list[tuple[int, FittedSequence, float]] = []

    def frames() -> Iterator[int]:
        for _, (number, item) in results:
            if isinstance(item, int):
                yield item
            else:
                ready.append((number, *item))

    try:
        for _ in progress(frames(), total=total, desc=f"fit {subject}", unit="frames"):
            while ready:
                yield ready.pop(0)
        yield from ready
    finally:
        results.close()


def _whole(
    fitted: FittedSequence, facts: Sequence[ScanFacts], usable: Sequence[int], source: str, seconds: float
) -> FittedFile:
    """Return the poses of all frames of a sequence; those that cannot be read have the pose of the nearest one."""
    frames = np.arange(len(facts))
    nearest = np.searchsorted((np.array(usable[1:]) + np.array(usable[:-1])) / 2, frames)  # the earlier one of two
    is_read = np.isin(frames, usable)
    reasons = [one_line(one.problem or fitted.reasons[nearest[frame]], LONGEST_REASON) for frame, one in enumerate(facts)]
    return FittedFile(
        fitted.poses[nearest],
        fitted.translation[nearest],
        np.where(is_read, fitted.residual_m[nearest], np.nan),
        is_read & fitted.is_trusted[nearest],
        tuple(reasons),
        fitted.unseen[nearest],
        source,
        seconds,
    )
