"""The splits of a subject's sequences, and the choice of held-out sequences for data sets that do not define it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatch
from typing import Literal

from snarfcli.errors import UserError, nearest

__all__ = ["SPLITS", "Split", "same_split", "split_sequences"]

Split = Literal["train", "test", "ood"]
SPLITS: tuple[Split, ...] = ("train", "test", "ood")
"""Training motion, held-out motion of the same kind, out-of-distribution motion; in this order everywhere."""

_TEST_SHARE = 0.2


def same_split(names: Iterable[str], split: Split) -> dict[str, Split]:
    """Return the same split for each name."""
    return dict.fromkeys(names, split)


def split_sequences(names: Sequence[str], test: Sequence[str], ood: Sequence[str]) -> dict[str, Split]:
    """Return the split of each sequence.

    Sequences that match a pattern of `test` or `ood` are held out. Without patterns, names that start with `ood` are out of
    distribution, and the last fifth of the others is for testing.

    Args:
        names: names of the sequences.
        test: names or patterns of sequences for testing; the last match of a pattern counts.
        ood: names or patterns of out-of-distribution sequences.

    Raises:
        UserError: a pattern matches no sequence, or no sequence is left to train on.
    """
    chosen: dict[str, Split] = {}
    held_out: tuple[tuple[Split, Sequence[str]], ...] = (("test", test), ("ood", ood))
    for split, patterns in held_out:
        for pattern in patterns:
            matches = [name for name in names if fnmatch(name, pattern)]
            if not matches:
                raise UserError(f"data.{split}: no sequence '{pattern}'{nearest(pattern, names)}; there is {', '.join(names)}")
            chosen.update(dict.fromkeys(matches, split))
    if not ood:
        chosen.update({name: "ood" for name in names if name not in chosen and name.lower().startswith("ood")})
    left = [name for name in names if name not in chosen]
    if not test and len(left) > 1:
        count = max(1, round(_TEST_SHARE * len(left)))
        chosen.update(dict.fromkeys(left[-count:], "test"))
    if not set(names) - set(chosen):
        raise UserError(f"no sequence is left to train on: {', '.join(names)} are all held out; give fewer in data.test")
    return {name: chosen.get(name, "train") for name in names}
