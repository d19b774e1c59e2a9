"""Find the sets of pose arrays in the content of a file: several persons, frames of a video, world and camera."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.errors import UserError, nearest
from snarfcli.motions.pose_keys import Frame, frame_of, is_of_camera, role_of
from snarfcli.motions.pose_parts import lead_axes

__all__ = ["Found", "PoseSet", "choose_set", "find_sets", "without_unread"]

log = logging.getLogger(__name__)

_MAX_DEPTH = 8
_MAX_NODES = 200_000
_MAX_SETS = 100_000
_MAX_VALUES = 2**24
_MAX_LISTED = 500_000  # numbers in nested lists; a pickle with more takes too many steps, but may repeat shorter lists
_PICTURE = re.compile(r".*\.(jpe?g|png|bmp|tiff?|webp|npz|npy|pkl|pickle|joblib|pt|pth)", re.IGNORECASE)
_PERSON_IDS = ("track_ids", "tracked_ids", "tid", "person_ids", "ids")
_DETECTIONS = ("center_confs", "center_preds")  # ROMP's result of one picture: the first axis is that of the persons

Found = dict[str, tuple[str, Any]]
"""Name and value of an array, by role."""


@dataclass(frozen=True, eq=False)
class PoseSet:
    """The arrays of one person in one frame of reference."""

    label: str
    """Where they are in the file, for example `smpl_params_global` or `0/world`."""
    found: Found
    """The arrays by role; of single pictures and as some files have them, a list with one array per frame."""
    frame: Frame
    """Frame of reference, as far as names tell."""
    depth: int
    """Number of containers around the arrays."""
    is_video: bool = False
    """Whether the frames were single pictures."""
    missing: int = 0
    """Number of pictures in which this person was not found; they are left out."""

    @property
    def has_poses(self) -> bool:
        """Whether there are poses, as a whole or in parts; otherwise there are joints of MHR."""
        return "poses" in self.found or {"root", "body"} <= {*self.found}


def without_unread(content: Any, depth: int = 0) -> Any:
    """Return nested dictionaries and lists without the arrays that are not read, such as vertices; their names stay."""

    def kept(key: Any, value: Any) -> Any:
        is_read = role_of(key) is not None or key in _PERSON_IDS or isinstance(value, (dict, list, tuple))
        return without_unread(value, depth + 1) if is_read else None

    if isinstance(content, dict) and depth <= _MAX_DEPTH:
        return {key: kept(key, value) for key, value in content.items()}
    if isinstance(content, list) and depth <= _MAX_DEPTH and any(isinstance(item, (dict, list)) for item in content[:1]):
        return [without_unread(item, depth + 1) for item in content[:_MAX_NODES]]
    return content


def find_sets(content: Any) -> list[PoseSet]:
    """Return the sets of pose arrays in nested dictionaries and lists, the preferred first.

    World coordinates are preferred to those of a camera, then arrays that are less deep in the file, then the order of the
    file. Frames of a video that are dictionaries of their own (by name of the picture, or lists of lists) are joined.

    Args:
        content: dictionaries, lists, tuples, arrays, numbers and text.
    """
    walk = _Walk()
    walk.visit(content, (), {}, is_frame=False)
    sets = [*walk.sets, *_joined(walk.frames, walk.pictures)]
    ranks = {"world": 0, "": 1, "camera": 2}
    return sorted(sets, key=lambda each: (ranks[each.frame], each.depth))


def choose_set(sets: Sequence[PoseSet], clip: str | int | None, path: Path) -> PoseSet:
    """Return the set of a label or number, the first by default; a log line says what else there is.

    Raises:
        UserError: there is none of this label or number.
    """
    labels = [each.label for each in sets]
    shown = ", ".join(f"{number}: {label[:40]}" for number, label in enumerate(labels[:12]))
    if clip is None:
        chosen = sets[0]
        if len(sets) > 1:
            log.info("%s: motion 0 of %d is used; others by clip=NAME or number (%s)", path.name, len(sets), shown)
    elif str(clip) in labels:
        chosen = sets[labels.index(str(clip))]
    elif str(clip).isdecimal() and len(str(clip)) < 10 and int(clip) < len(sets):
        chosen = sets[int(clip)]
    else:
        raise UserError(f"{path} has no motion {str(clip)[:40]!r}{nearest(str(clip), labels) or '.'} It has {shown}")
    if chosen.missing > 0:
        log.info("%s: frames without this person were left out: %d", path.name, chosen.missing)
    return replace(chosen, found={role: (key, _stacked(value, key, path)) for role, (key, value) in chosen.found.items()})


def _stacked(value: Any, key: str, path: Path) -> Any:
    """Return a list of arrays, one per frame, as one array; any other value unchanged."""
    if not isinstance(value, list) or not all(isinstance(item, np.ndarray) for item in value) or not value:
        return value
    count = sum(item.size for item in value)
    if count > _MAX_VALUES:
        raise UserError(f"pose file {path}: {key}: wanted at most {_MAX_VALUES} values, got {count}; cut it into parts")
    if any(item.size != value[0].size for item in value):
        raise UserError(f"pose file {path}: {key}: wanted arrays of one size in all frames, got others; repair the file")
    return np.stack([item.reshape(value[0].shape) for item in value])


class _Walk:
    """A walk through the content of a file that collects sets, and sets of single frames by the path of their person."""

    def __init__(self) -> None:
        self.sets: list[PoseSet] = []
        self.frames: dict[str, list[PoseSet]] = {}
        self.nodes = 0
        self.pictures = 0

    def visit(self, node: Any, path: tuple[str, ...], above: Found, is_frame: bool) -> None:
        self.nodes += 1
        full = self.nodes > _MAX_NODES or len(self.sets) > _MAX_SETS
        if full or len(path) > _MAX_DEPTH or not isinstance(node, (dict, list, tuple)):
            return
        if not isinstance(node, dict):
            self.visit_list(node, path, above, is_frame)
            return
        shared = {role: pair for role, pair in above.items() if role in ("frame_rate", "up")}
        shared |= {role: pair for role, pair in _by_role(node, "").items() if role in ("frame_rate", "up")}
        for each in _sets_of(node, path, shared):
            self.add(each, node, is_frame)
        are_frames = len(node) > 0 and all(isinstance(key, str) and _PICTURE.fullmatch(key) for key in node)
        self.pictures += len(node) if are_frames and not is_frame else 0
        for key, child in node.items():
            if self.nodes > _MAX_NODES:
                return
            name = _printable(key)
            ids = _ids(node, len(child)) if is_frame and isinstance(child, (list, tuple)) else None
            if ids is not None:
                for number, item in zip(ids, child, strict=True):
                    self.visit(item, (*path, name, number), shared, is_frame)
            else:
                self.visit(child, path if are_frames else (*path, name), shared, is_frame or are_frames)

    def visit_list(self, node: Sequence[Any], path: tuple[str, ...], above: Found, is_frame: bool) -> None:
        # A list of lists has frames of persons; a list of dictionaries has persons.
        are_frames = len(node) > 1 and all(isinstance(item, (list, tuple)) for item in node)
        self.pictures += len(node) if are_frames and not is_frame else 0
        for number, item in enumerate(node):
            if self.nodes > _MAX_NODES:
                return
            alone = len(node) == 1 and not is_frame
            self.visit(item, path if are_frames or alone else (*path, str(number)), above, is_frame or are_frames)

    def add(self, each: PoseSet, node: Mapping[Any, Any], is_frame: bool) -> None:
        of_pictures = is_frame or any(key in node for key in _DETECTIONS)
        persons = _persons(each, of_pictures)
        ids = _ids(node, len(persons)) or [str(number) for number in range(len(persons))]
        for number, person in zip(ids, persons, strict=True):
            if len(persons) > 1 or (is_frame and _ids(node, 1)):
                person = replace(person, label="/".join(filter(None, (person.label, number))))
            if is_frame:
                self.frames.setdefault(person.label, []).append(person)
            else:
                self.sets.append(person)


def _ids(node: Mapping[Any, Any], count: int) -> list[str] | None:
    """Return the identities of the persons of a frame as text, if it has `count` of them."""
    for key in _PERSON_IDS:
        ids = node.get(key)
        ids = ids.ravel().tolist() if isinstance(ids, np.ndarray) and ids.size <= _MAX_SETS else ids
        if isinstance(ids, (list, tuple)) and len(ids) == count and all(isinstance(one, (int, float, str)) for one in ids):
            return [f"person {one:g}" if isinstance(one, (int, float)) else _printable(one) for one in ids]
    return None


def _printable(key: object) -> str:
    """Return the name of a container for labels: at most 40 printable characters without a slash."""
    return "".join(letter if letter.isprintable() and letter != "/" else "?" for letter in str(key)[:40])


def _by_role(node: Mapping[Any, Any], frame: Frame) -> Found:
    """Return the arrays of a dictionary whose names mention a frame, by role."""
    ranked: dict[str, tuple[int, str, Any]] = {}
    for key, value in node.items():
        role = role_of(key)
        if role is None or role[1] != frame or isinstance(value, dict) or value is None:
            continue
        if role[0] not in ranked or role[2] < ranked[role[0]][0]:
            ranked[role[0]] = role[2], str(key), value
    return {role: (key, _plain(value)) for role, (_, key, value) in ranked.items()}


def _is_complete(found: Found) -> bool:
    return "poses" in found or {"root", "body"} <= {*found} or {"mhr_rotations", "mhr_positions"} <= {*found}


def _sets_of(node: Mapping[Any, Any], path: tuple[str, ...], shared: Found) -> Iterator[PoseSet]:
    """Yield the sets whose arrays are in one dictionary."""
    plain = _by_role(node, "")
    parts = {role: pair for role, pair in plain.items() if role not in ("poses", "root", "trans")}
    named: list[Frame] = [frame_of(part) for part in reversed(path) if frame_of(part)]
    groups: list[tuple[Frame, str, Found]] = []
    for frame in ("world", "camera"):
        framed = _by_role(node, frame)
        if "poses" in framed or "root" in framed:
            groups.append((frame, frame, {**shared, **parts, **framed}))
    has_world = any(frame == "world" for frame, _, _ in groups)
    guess: Frame = named[0] if named else "camera" if has_world or is_of_camera(node) else ""
    groups.append((guess, guess if groups else "", {**shared, **plain}))
    for frame, name, found in groups:
        if _is_complete(found):
            yield PoseSet("/".join(filter(None, (*path, name))), found, frame, len(path))


def _persons(each: PoseSet, of_pictures: bool) -> list[PoseSet]:
    """Return the set once per person, if the arrays have an axis of persons or are lists with one array per person.

    Args:
        each: a set.
        of_pictures: whether the first axis is that of the persons in one picture rather than that of frames.
    """
    role = next(role for role in ("poses", "body", "mhr_rotations") if role in each.found)
    main = each.found[role][1]
    is_list = isinstance(main, list) and all(isinstance(item, np.ndarray) and item.ndim > 1 for item in main)
    has_axis = isinstance(main, np.ndarray) and lead_axes(role, main) >= (1 if of_pictures else 2)
    if not is_list and not has_axis:
        return [each]
    return [_person(each, number, len(main)) for number in range(min(len(main), _MAX_SETS))]


def _person(each: PoseSet, number: int, count: int) -> PoseSet:
    def of_person(value: Any) -> Any:
        has_persons = isinstance(value, list) or (isinstance(value, np.ndarray) and value.ndim > 0)
        return value[number] if has_persons and len(value) == count else value

    return replace(each, found={role: (key, of_person(value)) for role, (key, value) in each.found.items()})


def _joined(frames: Mapping[str, list[PoseSet]], pictures: int) -> Iterator[PoseSet]:
    """Yield the sets whose frames are one set each, joined over time.

    Args:
        frames: sets of one frame by label.
        pictures: number of frames in the file.
    """
    for label, sets in frames.items():
        found: Found = {}
        for role, (key, first) in sets[0].found.items():
            if role in ("frame_rate", "up"):
                found[role] = key, first
            elif all(role in each.found for each in sets):
                found[role] = key, [each.found[role][1] for each in sets]
        if _is_complete(found):
            yield replace(sets[0], label=label, found=found, is_video=True, missing=pictures - len(sets))


def _plain(value: Any) -> Any:
    """Return numbers and lists of up to 500,000 numbers as an array, and several arrays as a list; others unchanged."""
    if isinstance(value, (np.ndarray, str)):
        return value
    if isinstance(value, (list, tuple)) and len(value) and all(isinstance(item, np.ndarray) for item in value):
        return list(value)
    if _is_large(value):
        return value
    try:
        return np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        return value


def _is_large(value: Any) -> bool:
    """Return whether nested lists have too many numbers to become an array."""
    lists, count = [value], 0
    while lists and count <= _MAX_LISTED:
        items = lists.pop()
        if isinstance(items, (list, tuple)):
            count += len(items) + 1
            lists.extend(item for item in items[:_MAX_LISTED] if isinstance(item, (list, tuple)))
    return count > _MAX_LISTED
