"""Motions in AMASS's format from any folder: each file is a sequence of a subject, on SMPL's body or the built-in one.

The folder is `data.folder`, or `<data_root>/amass`. If it has motion files itself, it is one subject, with all files below it:

    captures/walk.npz, captures/ood_flip.npz, captures/ood/kick.npz     data.folder=captures: subject captures

Otherwise each folder in it that has motion files, at any depth, is a subject, as in AMASS:

    CMU/01/01_01_poses.npz, CMU/02/02_01_poses.npz                      data.folder=CMU: subjects 01, 02

A sequence is named after its file, without `_poses` or `_stageii`, and the folders between: walk, ood_flip, ood_kick; 01_01.
The subject has one shape: that of `shape.npz`, or else of the first sequence that has one; without any, the average shape.

Held-out sequences are named by data.test and data.ood. Otherwise, sequences whose names start with `ood` are out of
distribution, and a fifth of the others is for testing: the last sequences by name, or, if there are fewer than five, the end of
each. The validation frames of a sequence are between its training frames and this end, so that these are no neighbours.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from snarfcli.bodies import Body, BodyNotFound, builtin_body, find_body, load_body
from snarfcli.checks import check_choice
from snarfcli.datasets.amass_files import SMPL_BETAS, AmassSubject, amass_sequences, sequence_name, walk_files
from snarfcli.datasets.sources import Request
from snarfcli.datasets.splits import SPLITS, Split, held_back_start, split_sequences
from snarfcli.datasets.subjects import SequenceSpec, SubjectData, body_sequence, body_template
from snarfcli.errors import UserError, nearest
from snarfcli.motions import read_shape
from snarfcli.motions.layouts import HANDS
from snarfcli.motions.up_axis import UPS, Up
from snarfcli.names import folder_names
from snarfcli.texts import counted

__all__ = ["load", "subjects"]

_WANTED = "motion files such as walk_poses.npz, or one folder of them per subject"
_LEFT_OUT = ("processed", "outputs")  # written by snarf
_FEWEST_SEQUENCES = 5  # of which a fifth is at least one


def subjects(request: Request) -> tuple[str, ...]:
    """Return the names of all subjects.

    Raises:
        UserError: the folder does not exist or has no motion files.
    """
    return tuple(_subject_places(request))


def load(subject: str, request: Request) -> SubjectData:
    """Read one subject.

    Raises:
        UserError: it does not exist, has no sequence that can be used or none to train on, or a setting does not fit. Single
            sequences that cannot be used are listed in `broken` instead.
    """
    config = request.config
    check_choice("data.hands", config.hands, HANDS)
    check_choice("data.up", config.up, UPS)
    places = _subject_places(request)
    if subject not in places:
        known = f"; wanted one of {', '.join(list(places)[:8])}"
        raise UserError(f"no subject '{subject}' in {_folder(request)}{nearest(subject, places) or known}")
    place = places[subject]
    files = _name_sequences(place)
    # With the broken sequences, so that repairing their files does not change the split of the others.
    splits = split_sequences(tuple(files), config.test, config.ood, fewest=_FEWEST_SEQUENCES)
    person, unreadable = _read_person(files, place, request)
    readable: dict[str, Split] = {name: split for name, split in splits.items() if name not in unreadable}
    up = cast(Up, config.up)
    sequences, broken = amass_sequences(files, readable, person, config.hands, place, up=up)
    broken = [*unreadable.items(), *broken]
    if not sequences:
        raise UserError(_first_reason(broken))
    sources = (*person.sources, f"motions: {counted(len(files), 'file')} in {place}")
    if "test" not in splits.values():
        count = len(sequences)
        sequences = _hold_back_ends(sequences, person)
        if len(sequences) > count:
            sources += (f"fewer than {_FEWEST_SEQUENCES} sequences in distribution: the last fifth of each is for testing",)
    sequences.sort(key=lambda spec: SPLITS.index(spec.split))
    template = body_template(person.body, person.betas, person.skeleton)
    return SubjectData(
        "amass", subject, person.skeleton, tuple(sequences), template, person.betas, sources, tuple(sorted(broken))
    )


# ---------------------------------------------------------------- files
def _folder(request: Request) -> Path:
    return request.folder if request.config.folder is not None else request.data_root / "amass"


def _subject_places(request: Request) -> dict[str, Path]:
    """Return the folder of each subject by name.

    Raises:
        UserError: there is no folder, or it has no motion files.
    """
    folder = _folder(request)
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "does not exist"
        raise UserError(f"the folder of motions {folder} {problem}; give data.folder=FOLDER with {_WANTED}")
    parents = [path.parent for path in _motion_files(folder)]
    if folder in parents:
        return {os.path.basename(os.path.abspath(folder)): folder}
    if not parents:
        raise UserError(f"no motion files in {folder}: wanted {_WANTED}; give data.folder=FOLDER, see data/README.md")
    return {name: folder / name for name in sorted({parent.relative_to(folder).parts[0] for parent in parents})}


def _motion_files(folder: Path) -> Iterator[Path]:
    """Yield the motion files below a folder; files that have only the shape of a subject are left out."""
    for path in walk_files(folder, _LEFT_OUT):
        stem = path.stem.lower()
        if stem != "shape" and not stem.endswith("stagei") and not stem.startswith("."):
            yield path


def _name_sequences(place: Path) -> dict[str, Path]:
    """Return the motion files of a subject by name of the sequence, in the order of the names."""
    found = sorted(
        ("_".join((*path.relative_to(place).parts[:-1], sequence_name(path))), path) for path in _motion_files(place)
    )
    return dict(sorted(zip(folder_names(name for name, _ in found), (path for _, path in found), strict=True)))


# ---------------------------------------------------------------- the person
def _read_person(files: Mapping[str, Path], place: Path, request: Request) -> tuple[AmassSubject, dict[str, str]]:
    """Return the body in the shape of the subject, and the sequences whose shape cannot be read, with the reason."""
    beside = [folder / "shape.npz" for folder in (place, *(path.parent for path in files.values()))]
    given = next((path for path in beside if path.is_file()), None)
    shapes: dict[Path, tuple[str, NDArray[np.float64]]] = {}
    unreadable: dict[str, str] = {}
    if given is not None:
        shapes[given] = read_shape(given)
    else:
        for name, path in files.items():
            try:
                shapes[path] = read_shape(path, needs_betas=False)
            except UserError as error:
                unreadable[name] = str(error)
        if not shapes:
            raise UserError(_first_reason(list(unreadable.items())))
    first = next((path for path, (_, betas) in shapes.items() if len(betas)), next(iter(shapes)))
    gender, betas = shapes[first]
    body, source, is_builtin = _find_body(request, gender)
    betas = betas[: min(len(betas), SMPL_BETAS, body.num_betas)]
    source_of_shape = f"shape {first}"
    if not betas.any():
        source_of_shape = "the average shape of the body"
    elif is_builtin:
        source_of_shape += " (parameters made for SMPL give another shape with the built-in body)"
    elif first.stem.lower().endswith("_stageii"):
        source_of_shape += " (made for SMPL-X: gives another shape with SMPL)"
    others = sum(not _is_same(shapes[first], shape) for shape in shapes.values() if len(shape[1]))
    if others:
        source_of_shape += f"; {others} of {len(shapes)} sequences have another shape or gender, which is not used"
    return AmassSubject(body, betas, body.skeleton(betas), (source, source_of_shape)), unreadable


def _find_body(request: Request, gender: str) -> tuple[Body, str, bool]:
    """Return the body, its origin, and whether it is the built-in one, which is used if SMPL's of this gender is not found."""
    try:
        path = find_body(request.body or request.data_root, "smpl", gender)
    except BodyNotFound:
        if request.body is not None:
            raise
        return builtin_body(), f"the built-in body (CC0); no {gender} SMPL model below {request.data_root}", True
    return load_body(path), f"body {path} ({gender})", False


def _is_same(one: tuple[str, NDArray], other: tuple[str, NDArray]) -> bool:
    mine, theirs = (np.pad(betas[:SMPL_BETAS], (0, max(0, SMPL_BETAS - len(betas)))) for _, betas in (one, other))
    return one[0] == other[0] and np.allclose(mine, theirs, atol=1e-4)


# ---------------------------------------------------------------- sequences
def _hold_back_ends(sequences: list[SequenceSpec], person: AmassSubject) -> list[SequenceSpec]:
    """Return the sequences, those for training without their last fifth, which is another sequence for testing.

    Single frames are not split.
    """
    cut = [spec.split == "train" and spec.motion.num_frames > 1 for spec in sequences]
    names = folder_names([spec.name for spec in sequences] + [f"{spec.name}_end" for spec in sequences])
    parts = []
    for spec, is_cut, name in zip(sequences, cut, names[len(sequences) :], strict=True):
        if not is_cut:
            parts.append(spec)
            continue
        start = held_back_start(spec.motion.num_frames)
        begin, end = spec.motion.slice(stop=start), replace(spec.motion.slice(start), name=name)
        parts.append(body_sequence(spec.name, "train", begin, person.body, person.betas))
        parts.append(body_sequence(name, "test", end, person.body, person.betas))
    return parts


def _first_reason(broken: list[tuple[str, str]]) -> str:
    """Return why no sequence can be used, as one line."""
    more = f" (and {len(broken) - 1} more sequences cannot be used)" if broken[1:] else ""
    return broken[0][1] + more
