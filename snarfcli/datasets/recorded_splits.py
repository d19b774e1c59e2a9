"""Choose the splits of recorded sequences, so that held-out motion is motion and differs from that of training."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from snarfcli.datasets.alike import find_twins, is_named_rest, is_still, pose_points
from snarfcli.datasets.recorded_sequence import RecordedSequence
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.skeleton_files import SkeletonFile
from snarfcli.datasets.splits import Split, split_sequences
from snarfcli.errors import UserError
from snarfcli.files import read_json

__all__ = ["ChosenSplits", "choose_splits", "split_patterns"]

_COMPARED_FRAMES = 128  # of a sequence
_LISTED = 6


@dataclass(frozen=True)
class ChosenSplits:
    """Sequences, of which some may be parts, and their splits."""

    recordings: list[RecordedSequence]
    splits: dict[str, Split]
    """Split of each sequence by name."""
    facts: tuple[str, ...]
    """Lines that say what decided."""
    warnings: tuple[str, ...]
    """Lines that should be checked."""


def choose_splits(
    recordings: list[RecordedSequence], broken: Iterable[str], skeleton: SkeletonFile, test: list[str], ood: list[str]
) -> ChosenSplits:
    """Return the splits of sequences.

    Patterns decide if there are any. Otherwise sequences that show one pose only are for training, sequences with the same
    poses share a split, and if there is only one moving sequence, its last fifth is held out.

    Args:
        recordings: sequences that can be used.
        broken: names of sequences that cannot be used. They count too, so that repairing their files does not change the split
            of the others.
        skeleton: their skeleton.
        test: names or patterns of sequences for testing.
        ood: names or patterns of out-of-distribution sequences.

    Raises:
        UserError: a pattern matches no sequence, or no sequence is left to train on.
    """
    names = sorted([*(recording.name for recording in recordings), *broken])
    points = {recording.name: _points(recording, skeleton) for recording in recordings}
    rests = [name for name in names if is_named_rest(name) or (name in points and _is_at_rest(points[name], skeleton))]
    still = [name for name in names if name in points and is_still(points[name]) and name not in rests]
    twins = find_twins({name: values for name, values in points.items() if name not in (*rests, *still)})
    splits: dict[str, Split] = dict.fromkeys(names, "train")
    if len(names) > 1 or test:
        splits = split_sequences(names, test, ood, alike=twins, still=(rests, still))
    facts, warnings = _about_rests(rests, still, splits), []
    if not test and "test" not in splits.values() and (len(names) == 1 or rests or still or twins):
        moving = {name for name, split in splits.items() if split == "train" and name not in (*rests, *still)}
        recordings = _with_ends(recordings, moving or set(names[:1]), splits)
    for group in twins:
        text = f"{', '.join(group[:_LISTED])} show the same poses"
        if len({splits[name] for name in group}) == 1:
            facts.append(f"{text}, so they share a split")
        else:
            warnings.append(f"{text}, but are in different splits, so held-out poses are trained on; hold out all or none")
    return ChosenSplits(recordings, splits, tuple(facts), tuple(warnings))


def split_patterns(place: Path, config: DataConfig) -> tuple[list[str], list[str]]:
    """Return the patterns of test and of out-of-distribution sequences from the settings, or else from `split.json`.

    A list `train` in the file is allowed, but not used: all other sequences are for training.

    Raises:
        UserError: the file cannot be read, or has another form.
    """
    path = place / "split.json"  # does not exist if `place` is a file
    content = read_json(path, "split") if path.is_file() else {}
    if not isinstance(content, dict) or not set(content) <= {"test", "ood", "train"}:
        raise UserError(
            f'split {path}: wanted an object such as {{"test": ["walk"], "ood": ["jump*"]}}, got another; repair it'
        )
    for name, patterns in content.items():
        if not isinstance(patterns, list) or not all(isinstance(pattern, str) for pattern in patterns):
            raise UserError(f"split {path}: {name}: wanted a list of names, got another value; repair it")
    return config.test or content.get("test", []), config.ood or content.get("ood", [])


def _points(recording: RecordedSequence, skeleton: SkeletonFile) -> np.ndarray:
    usable = recording.usable_frames
    frames = usable[np.unique(np.linspace(0, len(usable) - 1, min(len(usable), _COMPARED_FRAMES)).round().astype(int))]
    return pose_points(recording.bone_transforms(frames, skeleton), skeleton.joints_rest, skeleton.parents)


def _is_at_rest(points: np.ndarray, skeleton: SkeletonFile) -> bool:
    """Return whether all poses of a sequence are the rest pose."""
    at_rest = np.tile(np.eye(4), (1, len(skeleton.parents), 1, 1))
    return is_still(np.concatenate([pose_points(at_rest, skeleton.joints_rest, skeleton.parents), points]))


def _about_rests(rests: Sequence[str], still: Sequence[str], splits: dict[str, Split]) -> list[str]:
    names = [name for name in (*rests, *still) if splits[name] == "train"]
    if not names or len(names) == len(splits):
        return []
    shown = ", ".join(names[:_LISTED]) + (", ..." if len(names) > _LISTED else "")
    return [f"for training, as they show one pose only: {shown}; data.test=[NAME] holds out others"]


def _with_ends(recordings: list[RecordedSequence], chosen: set[str], splits: dict[str, Split]) -> list[RecordedSequence]:
    """Return the sequences with the last fifth of the chosen ones as sequences of their own, whose split is `test`."""
    found = []
    for recording in recordings:
        parts = recording.split_off_test() if recording.name in chosen else [recording]
        for part in parts[1:]:
            name = part.name
            while name in splits:
                name += "_end"
            splits[name] = "test"
            found.append(replace(part, name=name))
        found.append(parts[0])
    return found
