"""Check the descriptions in the folder of processed samples: `manifest.json` and the `sequence.json` of each sequence.

They stay dicts, with entries that only a reader of the JSON file needs. These dataclasses are what the package relies on.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snarfcli.datasets.splits import SPLITS
from snarfcli.descriptions import DescriptionError, read_described
from snarfcli.errors import UserError
from snarfcli.samples.layout import SEQUENCE_FILES, check_format, repair_advice

__all__ = ["check_manifest", "is_sequence"]

_MOST_POINTS = 2**40  # of a sequence
_MOST_RATE = 1e6
_LONGEST_NAME = 255


@dataclass
class _File:
    bytes: int
    sha256: str


@dataclass
class _Sequence:
    name: str
    split: str
    frames: int
    points_per_frame: int
    frame_rate: float
    files: dict[str, _File]


@dataclass
class _Manifest:
    data: str
    subject: str
    files: dict[str, _File]
    sequences: list[_Sequence]


def check_manifest(content: Any, folder: Path) -> None:
    """Check the manifest of a subject.

    Args:
        content: of the file.
        folder: folder of the subject, for messages.

    Raises:
        UserError: its version differs, or it is damaged.
    """
    check_format(content, folder)
    try:
        manifest = read_described(_Manifest, content, "manifest.json", ignore_unknown=True)
        _check_files(manifest.files, ("subject.npz",), "manifest.json")
        places = [(sequence.split, sequence.name) for sequence in manifest.sequences]
        for index, sequence in enumerate(manifest.sequences):
            _check_sequence(sequence, f"manifest.json.sequences[{index}]")
        for name in ("data", "subject"):
            value = getattr(manifest, name)
            if not value.isprintable() or len(value) > _LONGEST_NAME:
                raise DescriptionError(f"manifest.json.{name}: wanted a short printable name, got {value!r:.60}")
        if not places or len(set(places)) < len(places):
            raise DescriptionError("manifest.json.sequences: wanted different sequences, at least one")
    except DescriptionError as error:
        raise UserError(f"the samples in {folder} are damaged: {error}; {repair_advice(folder)}") from None


def is_sequence(content: Any) -> bool:
    """Return whether content describes a sequence."""
    try:
        _check_sequence(read_described(_Sequence, content, "sequence.json", ignore_unknown=True), "sequence.json")
    except DescriptionError:
        return False
    return True


def _check_sequence(sequence: _Sequence, where: str) -> None:
    """Check the values of the description of a sequence, whose types are right.

    Raises:
        DescriptionError: one is out of range.
    """
    name = sequence.name
    if (
        name in ("", ".", "..")
        or not name.isprintable()
        or len(name) > _LONGEST_NAME
        or any(letter in name for letter in "/\\:")
    ):
        raise DescriptionError(f"{where}.name: wanted the name of a folder, got {name!r:.60}")
    if sequence.split not in SPLITS:
        raise DescriptionError(f"{where}.split: wanted one of {', '.join(SPLITS)}, got {sequence.split!r:.60}")
    points = sequence.points_per_frame
    if not 0 < sequence.frames <= _MOST_POINTS or not 0 < points <= _MOST_POINTS or points % 8:
        raise DescriptionError(f"{where}: wanted frames of a multiple of 8 points, got {sequence.frames} of {points}")
    if not 0 < sequence.frame_rate <= _MOST_RATE:
        raise DescriptionError(f"{where}.frame_rate: wanted more than 0, got {sequence.frame_rate:g}")
    _check_files(sequence.files, SEQUENCE_FILES, where)


def _check_files(files: dict[str, _File], names: tuple[str, ...], where: str) -> None:
    if sorted(files) != sorted(names):
        raise DescriptionError(f"{where}.files: wanted {', '.join(names)}, got other names")
