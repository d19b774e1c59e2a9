"""Find sequences of AMASS in any folder layout, and read the body of their subject."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray
from omegaconf import OmegaConf

from snarfcli.bodies import Body, Skeleton, find_body, load_body
from snarfcli.datasets.sources import Request
from snarfcli.datasets.splits import Split
from snarfcli.datasets.subjects import SequenceSpec, body_sequence
from snarfcli.errors import UserError
from snarfcli.motions import read_motion, read_shape
from snarfcli.motions.up_axis import Up

__all__ = [
    "SMPL_BETAS",
    "AmassSubject",
    "amass_sequences",
    "find_sequences",
    "find_subjects",
    "papers_split",
    "read_amass_subject",
    "sequence_name",
    "walk_files",
]

SMPL_BETAS = 10
"""Number of shape parameters that are used, the first ones, as in the papers."""
_DEPTH = 7  # archives unpack to at most three nested folders, which are often inside further folders
_LEFT_OUT = {
    "processed", "outputs",  # written by snarf
    "mosh", "mpi_mosh", "mpimosh",  # in AMASS too, with names as in DFaust: 50002/jumping_jacks_poses.npz
}  # fmt: skip
_KINDS = ("_poses", "_stageii")
"""Ends of the file names of the older (SMPL-H) and the newer release (SMPL-X); the papers used the older."""


@lru_cache(maxsize=1)
def papers_split() -> dict:
    """Return the split of the papers: `dfaust` by subject, and `poseprior`."""
    return cast(dict, OmegaConf.to_container(OmegaConf.load(Path(__file__).with_name("dfaust_split.yaml"))))


def walk_files(root: Path, left_out: Iterable[str] = _LEFT_OUT) -> Iterator[Path]:
    """Yield the `.npz` files at most seven folders deep, in a fixed order; links are followed, hidden folders are not.

    Args:
        root: the folder.
        left_out: names of folders, in lower case, that are not searched.
    """
    left_out = set(left_out)
    for folder, names, files in os.walk(root, followlinks=True):
        depth = len(Path(folder).relative_to(root).parts)
        wanted = (name for name in names if name.lower() not in left_out and not name.startswith("."))
        names[:] = sorted(wanted) if depth < _DEPTH else []
        for file in sorted(files):
            if file.lower().endswith(".npz"):
                yield Path(folder) / file


def find_sequences(root: Path, subject: str, names: Iterable[str]) -> dict[str, Path]:
    """Return the AMASS files of a subject's sequences anywhere below a folder, by name.

    A file belongs to the subject if its name starts with that of the subject (`DFaust_67/50002/50002_hips_poses.npz`,
    `DFaust/50002/50002_hips_stageii.npz`). Only if there are no such files, the name of its folder counts
    (`MPI_Limits/03099/op2_poses.npz`), since other archives have folders of the same name. If there are several files of one
    sequence, the older release (SMPL-H) is preferred, then the less deep path.
    """
    wanted = "|".join(map(re.escape, names))
    pattern = re.compile(rf"({re.escape(subject)}_)?({wanted})({'|'.join(_KINDS)})\.npz", re.IGNORECASE)
    matches = [(match, path) for path in walk_files(root) if (match := pattern.fullmatch(path.name))]
    is_named = any(match[1] for match, _ in matches)
    found: dict[str, list[tuple[int, int, str, Path]]] = {}
    for match, path in matches:
        if match[1] or (not is_named and path.parent.name == subject):
            rank = (_KINDS.index(match[3].lower()), len(path.parts), str(path), path)
            found.setdefault(match[2].lower(), []).append(rank)
    return {name: min(ranks)[3] for name, ranks in found.items()}


def sequence_name(path: Path) -> str:
    """Return the name of a file without the ending of AMASS: hips for `hips_poses.npz` and `hips_stageii.npz`."""
    kind = next((kind for kind in _KINDS if path.stem.lower().endswith(kind)), "")
    return path.stem[: len(path.stem) - len(kind)]


def find_subjects(root: Path, subjects: Iterable[str]) -> tuple[str, ...]:
    """Return those of the given subjects that have AMASS files below a folder."""
    there: set[str] = set()
    for path in walk_files(root):
        if path.stem.lower().endswith(_KINDS):
            there |= {path.name.split("_")[0], path.parent.name}
    return tuple(subject for subject in subjects if subject in there)


@dataclass(frozen=True, eq=False)
class AmassSubject:
    """A body model in the shape of one subject of AMASS."""

    body: Body
    betas: NDArray[np.float64]
    """[S], shape parameters."""
    skeleton: Skeleton
    sources: tuple[str, ...]
    """The files that were read, for the manifest."""


def read_amass_subject(files: Mapping[str, Path], request: Request) -> AmassSubject:
    """Return the subject of some sequences: shape and gender from `shape.npz` beside them or from a sequence, and the body.

    Raises:
        UserError: there is no body model of this gender, or `shape.npz`, or without one all sequences, cannot be used.
    """
    beside = [path.parent / "shape.npz" for path in files.values() if (path.parent / "shape.npz").is_file()]
    shape, gender, betas = _first_shape(beside[:1] or list(files.values()))
    path = find_body(request.body or request.data_root, "smpl", gender)
    body = load_body(path)
    betas = betas[: min(len(betas), SMPL_BETAS, body.num_betas)]
    # The shape space of SMPL-X differs from that of SMPL.
    caution = " (made for SMPL-X: gives another shape with SMPL)" if shape.stem.lower().endswith("_stageii") else ""
    sources = (f"body {path} ({gender})", f"shape {shape}{caution}", f"motions {next(iter(files.values())).parent}")
    return AmassSubject(body, betas, body.skeleton(betas), sources)


def _first_shape(files: Sequence[Path]) -> tuple[Path, str, NDArray[np.float64]]:
    """Return the first readable file, and its gender and shape; damaged files are skipped if another can be read."""
    problem = None
    for file in files:
        try:
            return file, *read_shape(file)
        except UserError as error:
            problem = problem or error
    raise problem or ValueError("files: wanted at least one")


def amass_sequences(
    files: Mapping[str, Path],
    splits: Mapping[str, Split],
    person: AmassSubject,
    hands: str,
    where: Path,
    *,
    up: Up = "z",
) -> tuple[list[SequenceSpec], list[tuple[str, str]]]:
    """Read sequences without their translation, as in the papers.

    Args:
        files: the files by name of the sequence.
        splits: the split of each wanted sequence, by name.
        person: the subject.
        hands: see `read_motion`.
        where: folder that was searched, for messages.
        up: up axis of the files; z in AMASS.

    Returns:
        sequences: the sequences that were read.
        broken: name and reason of each sequence that is missing or cannot be read.
    """
    sequences, broken = [], []
    for name, split in splits.items():
        if name not in files:
            broken.append((name, f"has no file below {where}"))
            continue
        try:
            motion = read_motion(files[name], person.skeleton, up=up, hands=hands)
        except UserError as error:
            broken.append((name, str(error)))
            continue
        motion = replace(motion, name=name, translation=np.zeros_like(motion.translation))
        sequences.append(body_sequence(name, split, motion, person.body, person.betas))
    return sequences, broken
