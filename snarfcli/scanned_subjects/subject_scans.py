"""All scans of a subject: every file is read once before other work, and some frames tell what all have in common."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snarfcli.datasets.recorded_sequence import FileToWorld
from snarfcli.errors import UserError
from snarfcli.parallel import run_in_processes
from snarfcli.progress import progress
from snarfcli.scanned_subjects.fit_options import FitOptions
from snarfcli.scanned_subjects.fitter import Fitter, RigFitter
from snarfcli.scanned_subjects.scan_files import ScanFacts, examine_files, read_scan
from snarfcli.scanned_subjects.scans import ScanFolder, ScanSequence
from snarfcli.scanned_subjects.survey import Sample, Survey, survey_samples
from snarfcli.texts import counted

__all__ = ["SubjectScans", "read_subject"]

log = logging.getLogger(__name__)

_FILES_PER_TASK = 200
_SAMPLES = 3  # frames of each sequence that are looked at
_MOST_SAMPLES = 36


@dataclass(frozen=True, eq=False)
class SubjectScans:
    """The scans of a subject, and how to read them."""

    folders: tuple[ScanFolder, ...]
    """The sequences."""
    facts: tuple[tuple[ScanFacts, ...], ...]
    """Per sequence and frame, what reading the file has shown."""
    survey: Survey
    """What the files are like."""
    options: FitOptions
    """Settings."""

    @property
    def names(self) -> list[str]:
        """Names of the sequences."""
        return [folder.name for folder in self.folders]

    def usable(self, number: int) -> list[int]:
        """Return the numbers of the frames of a sequence that can be read."""
        return [frame for frame, facts in enumerate(self.facts[number]) if not facts.problem]

    def topology(self, number: int) -> str:
        """Return the digest of the faces that all frames of a sequence share, empty if they share none."""
        found = {facts.topology for facts in self.facts[number] if not facts.problem}
        return found.pop() if len(found) == 1 else ""

    def shared_topology(self) -> str:
        """Return the digest of the faces that all frames of all sequences share, empty if they share none."""
        found = {self.topology(number) for number in range(len(self.folders)) if self.usable(number)}
        return found.pop() if len(found) == 1 else ""

    def spread_frames(self, count: int) -> list[tuple[int, int]]:
        """Return at most `count` frames spread over all sequences: sequence, and place among its usable frames."""
        frames = [(number, index) for number in range(len(self.folders)) for index in range(len(self.usable(number)))]
        return [frames[index] for index in np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))]

    def sequence(self, number: int, world: FileToWorld) -> ScanSequence:
        """Return the frames of a sequence that can be read, as points in metres."""
        whole = ScanSequence(
            self.folders[number].paths,
            world,
            self.options.points_per_frame,
            self.survey.floors.get(number),
            number in self.survey.has_parts,
            self.survey.shares[number],
            number in self.survey.wrong_normals,
            self.options.seed,
        )
        return whole.chosen(self.usable(number))


def read_subject(
    subject: str, folders: Sequence[ScanFolder], options: FitOptions, fitter: Fitter, known: FileToWorld | None
) -> SubjectScans:
    """Read every file once, and look at some frames of each sequence.

    Args:
        subject: name of the subject, for messages.
        folders: its sequences.
        options: settings.
        fitter: the body.
        known: unit and axes that an earlier fit has found.

    Raises:
        UserError: a file cannot be read and may not be left out, no sequence can be used, or the unit cannot be guessed.
    """
    facts = _read_all(subject, folders, options)
    kept = [number for number, of_it in enumerate(facts) if any(not one.problem for one in of_it)]
    if not kept:
        raise UserError(f"subject {subject}: no scan can be used; {facts[0][0].problem}")
    samples = _samples(folders, facts, options)
    scale, up = (options.scale, options.up) if known is None else (repr(known.scale), known.up)
    body_m = None if isinstance(fitter, RigFitter) else fitter.length_m
    names = [folder.name for folder in folders]
    survey = survey_samples(samples, names, body_m, scale, up, is_upright=fitter.is_upright)
    return SubjectScans(tuple(folders), tuple(facts), survey, options)


def _read_all(subject: str, folders: Sequence[ScanFolder], options: FitOptions) -> list[tuple[ScanFacts, ...]]:
    """Return what is known of each frame of each sequence."""
    parts = [
        (number, folder.paths[start : start + _FILES_PER_TASK])
        for number, folder in enumerate(folders)
        for start in range(0, len(folder.paths), _FILES_PER_TASK)
    ]
    found: list[list[ScanFacts]] = [[] for _ in parts]
    results = run_in_processes(examine_files, ((paths,) for _, paths in parts), options.workers)
    total = sum(len(paths) for _, paths in parts)
    try:
        for task, facts in progress(results, total=total, desc=f"reading {subject}", unit="scans"):
            if facts.problem and not options.skip_broken:
                raise UserError(f"{facts.problem}; give skip_broken=true to leave such frames out")
            found[task].append(facts)
    finally:
        results.close()
    by_sequence: list[list[ScanFacts]] = [[] for _ in folders]
    for (number, _), of_part in zip(parts, found, strict=True):
        by_sequence[number] += of_part
    for folder, of_it in zip(folders, by_sequence, strict=True):
        problems = [facts.problem for facts in of_it if facts.problem]
        if problems:
            log.warning("left out: %s of sequence %s (%s)", counted(len(problems), "frame"), folder.name, problems[0])
    return [tuple(of_it) for of_it in by_sequence]


def _samples(folders: Sequence[ScanFolder], facts: Sequence[Sequence[ScanFacts]], options: FitOptions) -> list[Sample]:
    """Return some frames of each sequence, units and axes of the files."""
    each = max(1, min(_SAMPLES, _MOST_SAMPLES // len(folders)))
    samples = []
    for number, folder in enumerate(folders):
        usable = [frame for frame, one in enumerate(facts[number]) if not one.problem]
        some = np.unique(np.linspace(0, len(usable) - 1, each).round().astype(int)) if usable else []
        for frame in (usable[index] for index in some):
            scan = read_scan(folder.paths[frame], options.points_per_frame, options.seed + frame, check_normals=True)
            samples.append(Sample(number, frame, scan.points, scan.normals, scan.change))
    return samples
