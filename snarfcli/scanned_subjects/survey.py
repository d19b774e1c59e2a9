"""What all scans of a subject have in common: unit, up axis, floor, and other things beside the subject."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snarfcli.checks import alternatives
from snarfcli.datasets.recorded_sequence import person_scale
from snarfcli.errors import UserError
from snarfcli.scanned_subjects.surroundings import AXES, Floor, Part, find_floor, find_parts, robust_box, without_surroundings

__all__ = ["Sample", "Survey", "survey_samples"]

Array = NDArray[np.float64]

_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}  # metres per unit of those that are guessed
_LENGTHS = (0.35, 1.55)  # of what is seen, as a share of the longest side of the body at rest: from crouching to reaching up
_CLEAR = 1.3  # ratio of two sides, above which the longer one is the height
_MOST_FLOORS = 0.5  # share of the samples that show a floor, if the sequence has one
_LIKE_THE_SUBJECT = (0.5, 1.8)  # lengths of another part, as shares of that of the subject, that can be another person
_LISTED = 4  # names on one line
_SHARE_OF_A_PERSON = 0.35  # of the number of points of the subject


@dataclass(frozen=True, eq=False)
class Sample:
    """One frame that is looked at, units and axes of the files."""

    sequence: int
    """Number of the sequence."""
    frame: int
    """Number of the frame."""
    points: Array
    """[P, 3]."""
    normals: Array
    """[P, 3], unit length."""
    change: str = ""
    """What was wrong with the normals of the file; empty if nothing was."""


@dataclass(frozen=True)
class Survey:
    """What the files are like."""

    scale: float
    """Metres per unit."""
    up: str | None
    """Up axis, y or z; None if the extent does not tell."""
    floors: Mapping[int, Floor]
    """Floors by number of the sequence, units and axes of the files."""
    has_parts: frozenset[int]
    """Numbers of the sequences in which other things stand apart."""
    wrong_normals: frozenset[int]
    """Numbers of the sequences whose files have normals that are wrong in some frames."""
    shares: Mapping[int, float]
    """Smallest share of the points that is on the subject, by number of the sequence."""
    others: tuple[tuple[Array, Array], ...]
    """Points [P, 3] and normals [P, 3] of parts that can be another person, units and axes of the files."""
    facts: tuple[str, ...]
    """Lines about all this."""


def survey_samples(
    samples: Sequence[Sample], names: Sequence[str], body_m: float | None, scale: str, up: str, *, is_upright: bool = True
) -> Survey:
    """Look at some frames of each sequence.

    Args:
        samples: frames, at least one of each sequence.
        names: of the sequences.
        body_m: longest side of the body at rest, metres; None if the body has no size of its own.
        scale: the setting data.scale: auto, or metres per unit.
        up: the setting data.up: auto, y or z.
        is_upright: whether the body is usually highest when it stands.

    Raises:
        UserError: the unit cannot be guessed.
    """
    ups = tuple(AXES) if up == "auto" else (up,)
    seen = [find_floor(sample.points, sample.normals, ups, seed=sample.frame) for sample in samples]
    by_axis = {
        axis: _floors(samples, [floor if floor is not None and floor.up == axis else None for floor in seen]) for axis in ups
    }
    best = max(ups, key=lambda axis: len(by_axis[axis]))
    chosen_up = best if up != "auto" or by_axis[best] else None
    floors = by_axis[best]
    above = [without_surroundings(sample.points, sample.normals, floors.get(sample.sequence)) for sample in samples]
    parts = [find_parts(points) if len(points) > 1 else [] for points, _ in above]
    subjects = [points[found[0].is_in] for (points, _), found in zip(above, parts, strict=True) if found]
    boxes = [robust_box(points) for points in subjects]
    if not boxes:
        raise UserError("no points are left above the floor; give data.up=y or data.up=z, or cut the floor off")
    sides = np.array([high - low for low, high in boxes])
    metres, why = _scale(float(np.quantile(sides.max(1), 0.8)), body_m, scale)
    facts = [why]
    if chosen_up is None:
        chosen_up, why = _up(sides) if is_upright else (None, "")
        facts += [why] if why else []
    elif up == "auto":
        facts.append(f"up axis {chosen_up}: the scans show a floor (data.up=y or z sets it)")
    if floors:
        facts.append(f"left out: a floor, {_listed(names[number] for number in floors)}")
    apart = {sample.sequence: found for sample, found in zip(samples, parts, strict=True) if len(found) > 1}
    if apart:
        longest = max(part.length for found in apart.values() for part in found[1:])
        where = _listed(names[number] for number in apart)
        facts.append(f"left out: things apart from the subject, up to {metres * longest:.2f} m long, {where}")
    if floors or apart:
        facts.append(
            "they stay in the files: cut them off before snarf preprocess, or they are learned as a part of the subject"
        )
    wrong = {sample.sequence: sample.change for sample in samples if sample.change}
    facts += [f"normals of {names[number]} {change}" for number, change in list(wrong.items())[:_LISTED]]
    others = [
        (points[part.is_in], normals[part.is_in])
        for (points, normals), found in zip(above, parts, strict=True)
        for part in found[1:]
        if _is_like(part, found[0])
    ]
    shares = _shares(samples, parts)
    return Survey(metres, chosen_up, floors, frozenset(apart), frozenset(wrong), shares, tuple(others), tuple(facts))


def _shares(samples: Sequence[Sample], parts: Sequence[Sequence[Part]]) -> dict[int, float]:
    """Return the smallest share of the points that is on the subject, by number of the sequence."""
    shares: dict[int, float] = {}
    for sample, found in zip(samples, parts, strict=True):
        share = found[0].is_in.sum() / len(sample.points) if found else 1.0
        shares[sample.sequence] = min(share, shares.get(sample.sequence, 1.0))
    return shares


def _floors(samples: Sequence[Sample], seen: Sequence[Floor | None]) -> dict[int, Floor]:
    """Return the floor of each sequence that has one in most of its samples: the one of middle height."""
    floors = {}
    for number in sorted({sample.sequence for sample in samples}):
        of_it = [floor for sample, floor in zip(samples, seen, strict=True) if sample.sequence == number]
        found = sorted((floor for floor in of_it if floor is not None), key=lambda floor: floor.height)
        if found and len(found) >= _MOST_FLOORS * len(of_it):
            floors[number] = found[len(found) // 2]
    return floors


def _scale(length: float, body_m: float | None, wanted: str) -> tuple[float, str]:
    """Return the metres per unit, and the reason as text; `length` is that of the subject, units of the files."""
    if wanted != "auto":
        return float(wanted), f"one unit of the files is {float(wanted):g} m: {float(wanted) * length:.2f} m long"
    if body_m is None:
        return person_scale(length, length, wanted, None)
    low, high = (share * body_m for share in _LENGTHS)
    for name, metres in _UNITS.items():
        if low <= metres * length <= high:
            return (
                metres,
                f"the files are in {name}: {metres * length:.2f} m long (guessed; data.scale=NUMBER sets metres per unit)",
            )
    units = alternatives(f"{low / metres:.4g} to {high / metres:.4g} ({name})" for name, metres in _UNITS.items())
    size = f"{length:.4g}" if math.isfinite(length) else "not finite"
    raise UserError(
        f"the unit of the scans cannot be guessed: wanted a longest side of {units}, got {size}; "
        "give data.scale=METRES_PER_UNIT"
    )


def _up(sides: Array) -> tuple[str | None, str]:
    """Return the up axis by the median sides [K, 3] of what is seen, and the reason; None if they are alike."""
    middle = np.median(sides, 0)
    by_length = sorted(AXES, key=lambda up: -middle[AXES[up]])
    if middle[AXES[by_length[0]]] < _CLEAR * middle[AXES[by_length[1]]]:
        return None, ""
    return by_length[0], f"up axis {by_length[0]}: the scans are longest in it (guessed; data.up=y or z sets it)"


def _is_like(part: Part, subject: Part) -> bool:
    low, high = _LIKE_THE_SUBJECT
    return low * subject.length <= part.length <= high * subject.length and part.is_in.sum() >= (
        _SHARE_OF_A_PERSON * subject.is_in.sum()
    )


def _listed(names) -> str:
    """Return names as the end of a line."""
    names = list(names)
    return f"in {', '.join(names[:_LISTED])}" + (f" and {len(names) - _LISTED} more" if len(names) > _LISTED else "")
