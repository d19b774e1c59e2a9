"""Find a body model file by its usual names: as downloaded, renamed or converted."""

from __future__ import annotations

import os
import re
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from snarfcli.errors import UserError

__all__ = ["BODY_KINDS", "GENDERS", "BodyNotFound", "find_body"]

BODY_KINDS = ("smpl", "smplh", "smplx")
GENDERS = ("female", "male", "neutral")

_TITLES = {"smpl": "SMPL", "smplh": "SMPL-H", "smplx": "SMPL-X"}
_LETTERS = {"f": "female", "m": "male", "n": "neutral"}
_SUFFIX = r"\.(?P<suffix>npz|pkl)"
# A word after the name marks a copy, for example `_2020`, `_np`, `_clean`, `_py3`; other words mean other files.
_COPY = r"(?P<copy>(?:[_.-](?:\d+|v?\d+(?:\.\d+)+|np|clean|cleaned|py3|nochumpy|converted))*)"
_DOWNLOADED = re.compile(
    r"basicmodel_(?P<gender>f|m|n|female|male|neutral)_lbs_10_207_0_v(?P<version>\d+\.\d+\.\d+)" + _COPY + _SUFFIX
)
_RENAMED = re.compile(r"(?P<kind>smplh|smplx|smpl)_(?P<gender>female|male|neutral)" + _COPY + _SUFFIX)
_IN_FOLDER = re.compile(r"model" + _SUFFIX)
_FOLDER_OF_KIND = re.compile(r"(smplh|smpl\+h|smplx|smpl-x|smpl-h|smpl)(?![a-z])")
_NAMES = {
    "smpl": "basicmodel_{letter}_lbs_10_207_0_v*.pkl, SMPL_{GENDER}.pkl",
    "smplh": "SMPLH_{GENDER}.pkl, smplh/{gender}/model.npz",
    "smplx": "SMPLX_{GENDER}.npz, smplx/{gender}/model.npz",
}
# Deeper than any release unpacks. The limits keep a wrong folder, such as /, from being searched for minutes; CAPE, which often
# lies beside the bodies, has about 150,000 files in 600 folders.
_MAX_DEPTH = 6
_MAX_FOLDERS = 20_000
_MAX_ENTRIES = 1_000_000


@dataclass(frozen=True)
class _Found:
    kind: str
    gender: str
    version: tuple[int, ...]
    is_copy: bool
    path: Path
    depth: int

    @property
    def preference(self) -> tuple:
        version = tuple(-part for part in self.version) or (0,)
        is_pickle = self.path.suffix.lower() == ".pkl"
        return BODY_KINDS.index(self.kind), version, self.is_copy, is_pickle, self.depth, str(self.path)


class BodyNotFound(UserError):
    """There is no body model of the wanted kind and gender in a place."""


def find_body(place: str | Path, kind: str | None, gender: str) -> Path:
    """Find the body model file of a gender.

    If there are several, the first in this order is returned: SMPL, SMPL-H, SMPL-X (unless `kind` is given); the highest
    version in the name; the name as downloaded before a copy; `.npz` before `.pkl`; the less deep path; alphabetical order.

    Args:
        place: a model file, which is returned unchanged; or a folder, which is searched six levels deep for the names of the
            releases, in upper or lower case: `basicmodel_f_lbs_10_207_0_v1.1.0.pkl`, `SMPL_FEMALE.pkl`,
            `smplh/female/model.npz`, `SMPLX_FEMALE.npz`, and conversions of them.
        kind: smpl, smplh, smplx, or None for any.
        gender: female, male or neutral, in upper or lower case, or its first letter.

    Returns:
        The file, never that of another gender.

    Raises:
        BodyNotFound: the place does not exist or has no such model; the message lists what was found.
        UserError: the kind or gender is unknown, or the folder is too large to search.
    """
    place = Path(place).expanduser()
    wanted = _LETTERS.get(gender.strip().lower()[:1], "")
    if not gender.strip() or not wanted.startswith(gender.strip().lower()):
        raise UserError(f"body gender: wanted {', '.join(GENDERS)}, got {gender!r:.40}")
    if kind is not None and kind not in BODY_KINDS:
        raise UserError(f"body kind: wanted {', '.join(BODY_KINDS)}, got {kind!r:.40}")
    if place.is_file():
        return place
    if not place.is_dir():
        raise BodyNotFound(f"no body model at {place}; name a model file or a folder of model files")
    found = sorted(_search(place), key=lambda one: one.preference)
    for one in found:
        if one.gender == wanted and kind in (None, one.kind):
            return one.path
    title = _TITLES[kind] if kind else "body"
    names = ", ".join(names for of, names in _NAMES.items() if kind in (None, of))
    names = names.format(letter=wanted if wanted == "neutral" else wanted[0], gender=wanted, GENDER=wanted.upper())
    there = ", ".join(str(one.path.relative_to(place)) for one in found[:6]) + (", ..." if len(found) > 6 else "")
    raise BodyNotFound(
        f"no {wanted} {title} model in {place}; wanted {names}, got {there or 'no model'}; download it, or name a model file"
    )


def _search(place: Path) -> Iterator[_Found]:
    for path, depth in _files(place):
        name = path.name.lower()
        if match := _DOWNLOADED.fullmatch(name):
            version = tuple(int(part) for part in match["version"].split("."))
            gender = _LETTERS[match["gender"][0]]
            yield _Found("smpl", gender, version, bool(match["copy"]), path, depth)
        elif match := _RENAMED.fullmatch(name):
            yield _Found(match["kind"], match["gender"], (), bool(match["copy"]), path, depth)
        elif _IN_FOLDER.fullmatch(name):
            folders = [part.lower() for part in Path(os.path.abspath(path)).parent.parts[::-1]]
            if folders and folders[0] in GENDERS and (kind := _kind_of(folders[1:])):
                yield _Found(kind, folders[0], (), False, path, depth)


def _kind_of(folders: list[str]) -> str | None:
    """Return the kind of model that the nearest folder is named after; folders `dmpl...` hold other data of the same names."""
    for folder in folders:
        if folder.startswith("dmpl"):
            return None
        if match := _FOLDER_OF_KIND.match(folder):
            return match[1].replace("+", "").replace("-", "")
    return None


def _files(place: Path) -> Iterator[tuple[Path, int]]:
    """Yield the model files below a folder with their depth; links to folders are followed, but no folder is read twice."""
    seen: set[str] = set()
    waiting = deque([(place, 0)])
    entries = 0
    while waiting:
        folder, depth = waiting.popleft()
        real = os.path.realpath(folder)
        if real in seen:
            continue
        seen.add(real)
        try:
            content = sorted(os.scandir(folder), key=lambda entry: entry.name)
        except OSError:  # no permission
            continue
        entries += len(content)
        if entries > _MAX_ENTRIES or len(seen) > _MAX_FOLDERS:
            limits = f"at most {_MAX_ENTRIES:,} files and {_MAX_FOLDERS:,} folders"
            raise UserError(f"folder {place}: wanted {limits}, got more; name the folder of the body models by body=FOLDER")
        for entry in content:
            if entry.name.lower().endswith((".npz", ".pkl")):
                if entry.is_file():
                    yield folder / entry.name, depth
            elif depth < _MAX_DEPTH and entry.is_dir():
                waiting.append((folder / entry.name, depth + 1))
