"""What a fit found: `fit.json` beside the scans, lines for the terminal, and what `snarf doctor` says about it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.datasets.checking import Remark
from snarfcli.datasets.sources import Request
from snarfcli.errors import UserError
from snarfcli.files import read_json, write_json
from snarfcli.registration.joint_limits import near_limits
from snarfcli.scanned_subjects.scans import scan_subjects
from snarfcli.scanned_subjects.written import FitMade, FittedFile
from snarfcli.texts import counted, one_line
from snarfcli.versions import recorded_code, recorded_versions

__all__ = ["FIGURE", "REPORT", "SequenceReport", "fit_remarks", "report_remarks", "write_fit_report"]

FIGURE = "fit.png"
"""Name of the figure, in the folder of the subject."""
REPORT = "fit.json"
"""Name of the report, in the folder of the subject."""
_UNTRUSTED_SHARE = 0.1  # of the frames of a sequence, above which something should be done
_MOSTLY = 0.5  # of the frames
_LISTED = 8


@dataclass(frozen=True, eq=False)
class SequenceReport:
    """What was found for one sequence."""

    name: str
    """Name of the sequence."""
    number: int
    """Of the sequence."""
    fitted: FittedFile
    """Its poses."""
    joint_names: tuple[str, ...]
    """J joint names."""

    @property
    def untrusted(self) -> int:
        """Number of frames that are not trusted."""
        return int((~self.fitted.is_trusted).sum())

    @property
    def unseen_joints(self) -> list[str]:
        """Names of the joints that are not seen in most frames that are trusted; their rotations are only what is usual."""
        unseen = self.fitted.unseen[self.fitted.is_trusted]
        return [self.joint_names[joint] for joint in np.flatnonzero(unseen.sum(0) > _MOSTLY * len(unseen))]

    def residual_mm(self) -> tuple[float, float]:
        """Return the mean residual of the frames that can be read and the one that 95 % of them do not exceed, millimetres."""
        known = self.fitted.residual_m[np.isfinite(self.fitted.residual_m)]
        return 1000 * float(known.mean()), 1000 * float(np.quantile(known, 0.95))

    def line(self) -> str:
        """Return the line for the terminal."""
        mean, most = self.residual_mm()
        first = int(self.fitted.is_trusted.argmin())
        trusted = "all trusted"
        if self.untrusted:
            trusted = f"{self.untrusted} not trusted, such as frame {first} ({self.fitted.reasons[first]})"
        unseen = f"; joints not seen in most frames: {', '.join(self.unseen_joints)}" if self.unseen_joints else ""
        return (
            f"{self.name}: {counted(len(self.fitted.poses), 'frame')}, {mean:.1f} mm from the points on average, 95 % under "
            f"{most:.1f} mm; {trusted}{unseen}; {self.fitted.seconds:.0f} s of one core"
        )

    @cached_property
    def content(self) -> dict[str, Any]:
        """The entry of the report."""
        fitted = self.fitted
        mean, most = self.residual_mm()
        limits = near_limits(self.joint_names, fitted.poses)
        reasons: dict[str, list[int]] = {}
        for frame in np.flatnonzero(~fitted.is_trusted).tolist():
            reasons.setdefault(fitted.reasons[frame], []).append(frame)
        return {
            "name": self.name,
            "frames": len(fitted.poses),
            "not_trusted": self.untrusted,
            "residual_mm": round(mean, 2),
            "residual_mm_95": round(most, 2),
            "core_seconds": round(fitted.seconds, 1),
            "not_trusted_frames": [{"reason": reason, "frames": _runs(frames)} for reason, frames in reasons.items()],
            "not_seen": self.unseen_joints,
            "near_limits": {joint: _runs(frames) for joint, frames in sorted(limits.items())},
            "residual_mm_per_frame": [
                round(1000 * residual, 2) if math.isfinite(residual) else None for residual in fitted.residual_m.tolist()
            ],
        }


def write_fit_report(
    path: Path,
    header: Mapping[str, Any],
    made: FitMade,
    reports: Sequence[SequenceReport],
    *,
    is_complete: bool,
) -> None:
    """Write the report of a subject, whole or not at all.

    Args:
        path: the file.
        header: first entries.
        made: what was decided once for the subject.
        reports: of the sequences that are done.
        is_complete: whether these are all.
    """
    content = {
        "made_by": "snarf fit",
        **header,
        "complete": is_complete,
        "versions": recorded_versions(),
        "code": recorded_code(),
        "scale": made.world.scale,
        "up": made.world.up,
        "betas": np.asarray(made.betas).round(4).tolist(),
        "sequences": [report.content for report in reports],
    }
    write_json(path, content)


def fit_remarks(subject: str, request: Request) -> Iterator[Remark]:
    """Yield what the report of a subject says, and what to do; nothing if it was not fitted.

    Args:
        subject: name of the subject.
        request: the data set and its folders.
    """
    place = scan_subjects(request).get(subject) if request.config.name == "meshes" else None
    if place is not None and (place / REPORT).is_file():
        yield from report_remarks(place / REPORT)


def report_remarks(path: Path) -> list[Remark]:
    """Return what a report says, and what to do; if it is damaged, that."""
    try:
        return list(_remarks(read_json(path, "report")))
    except (UserError, KeyError, TypeError, ValueError, OverflowError):
        return [Remark("fit", f"{path} is damaged; run the same snarf fit again", "warning")]


def _remarks(content: Any) -> Iterator[Remark]:
    if content["complete"] is not True:
        yield Remark("fit", "not complete; run the same snarf fit again", "warning")
    for entry in content["sequences"][:_LISTED]:
        name, frames, lost = one_line(str(entry["name"]), 80), int(entry["frames"]), int(entry["not_trusted"])
        trusted = f"{lost} of {counted(frames, 'frame')} not trusted" if lost else "all frames trusted"
        text = f"{name}: {float(entry['residual_mm']):.1f} mm from the points on average, {trusted}"
        if lost > _UNTRUSTED_SHARE * frames:
            text += f"; see {FIGURE} and {REPORT}; cut other things off the scans, or give clothes=true for wide clothes"
            yield Remark("fit", text, "warning")
        else:
            yield Remark("fit", text)
        if entry["not_seen"]:
            joints = one_line(", ".join(map(str, entry["not_seen"])), 300)
            text = f"{name}: joints not seen in most frames: {joints}; their poses are only what is usual"
            yield Remark("fit", text, "warning")
    if len(content["sequences"]) > _LISTED:
        yield Remark("fit", f"and {counted(len(content['sequences']) - _LISTED, 'more sequence')}; see {REPORT}")


def _runs(frames: Sequence[int] | NDArray[np.intp]) -> str:
    """Return ascending numbers as text: 3-17, 20."""
    numbers = np.asarray(frames)
    parts = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return ", ".join(f"{part[0]}-{part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts)
