"""The splits of a subject's sequences, and the choice of held-out sequences for data sets that do not define it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatch
from typing import Literal

from snarfcli.errors import UserError, nearest

__all__ = ["SPLITS", "Split", "held_back_start", "same_split", "split_sequences"]

Split = Literal["train", "test", "ood"]
SPLITS: tuple[Split, ...] = ("train", "test", "ood")
"""Training motion, held-out motion of the same kind, out-of-distribution motion; in this order everywhere."""

_TEST_SHARE = 0.2  # of the sequences, or of the frames of a sequence
_LISTED = 12  # names in a message


def same_split(names: Iterable[str], split: Split) -> dict[str, Split]:
    """Return the same split for each name."""
    return dict.fromkeys(names, split)


def held_back_start(num_frames: int) -> int:
    """Return the first frame of the part of a sequence that is held back for testing: its last fifth, at least one frame."""
    return num_frames - max(1, round(_TEST_SHARE * num_frames))


def split_sequences(
    names: Sequence[str],
    test: Sequence[str],
    ood: Sequence[str],
    *,
    fewest: int = 2,
    alike: Sequence[Sequence[str]] = (),
    still: Sequence[Sequence[str]] = (),
) -> dict[str, Split]:
    """Return the split of each sequence.

    Sequences that match a pattern of `test` or `ood` are held out. Without patterns, names that start with `ood` are out of
    distribution, and the last fifth of the others, at least one, is for testing.

    Args:
        names: names of the sequences.
        test: names or patterns of sequences for testing; the last match of a pattern counts.
        ood: names or patterns of out-of-distribution sequences.
        fewest: of fewer other sequences, none is for testing without a pattern; the caller can hold back a part of each.
        alike: groups of sequences that count as one: without a pattern, all of a group are in the same split.
        still: lists of sequences that are for training without a pattern; a later list counts as others if too few others are
            left.

    Raises:
        UserError: a pattern matches no sequence, or no sequence is left to train on.
    """
    chosen: dict[str, Split] = {}
    held_out: tuple[tuple[Split, Sequence[str]], ...] = (("test", test), ("ood", ood))
    for split, patterns in held_out:
        for pattern in patterns:
            matches = [name for name in names if fnmatch(name, pattern)]
            if not matches:
                raise UserError(f"data.{split}: no sequence '{pattern}'{nearest(pattern, names)}; there is {_listed(names)}")
            chosen.update(dict.fromkeys(matches, split))
    if not ood:
        chosen.update({name: "ood" for name in names if name not in chosen and name.lower().startswith("ood")})
    if not test:
        left = [name for name in names if name not in chosen]
        chosen.update(dict.fromkeys(_last_groups(left, alike, still, fewest), "test"))
    if not set(names) - set(chosen):
        by_name = "" if ood else " (without data.ood, names that start with ood are)"
        raise UserError(
            f"no sequence is left to train on: {_listed(names)} are all held out{by_name}; name fewer in data.test and data.ood"
        )
    return {name: chosen.get(name, "train") for name in names}


def _last_groups(
    names: Sequence[str], alike: Sequence[Sequence[str]], still: Sequence[Sequence[str]], fewest: int
) -> list[str]:
    """Return the last fifth of the sequences, or of groups of them."""
    for number in range(len(still), -1, -1):
        left_out = {name for names in still[:number] for name in names}
        group_of = {name: tuple(group) for group in alike for name in group}
        moving = [name for name in names if name not in left_out]
        groups = list(dict.fromkeys(group_of.get(name, (name,)) for name in moving))
        if len(groups) >= fewest:
            count = max(1, round(_TEST_SHARE * len(groups)))
            return [name for group in groups[-count:] for name in group if name in names]
        if groups:
            break
    return []


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more
