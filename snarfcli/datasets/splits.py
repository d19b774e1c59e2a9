"""Which sequences of a subject are held out, for data sets that do not say it themselves."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatch

from snarfcli.datasets.subjects import Split
from snarfcli.errors import UserError, nearest

__all__ = ["split_sequences"]

_TEST_SHARE = 0.2


def split_sequences(names: Sequence[str], test: Sequence[str], ood: Sequence[str]) -> dict[str, Split]:
    """Return what each sequence is for: those that match the patterns of `test` and `ood`, or the last fifth for testing.

    Names that start with `ood` are out of distribution unless a pattern says otherwise.

    Raises:
        UserError: a pattern matches no sequence, or nothing is left to train on.
    """
    chosen: dict[str, Split] = {}
    for split, patterns in (("test", test), ("ood", ood)):
        for pattern in patterns:
            matches = [name for name in names if fnmatch(name, pattern)]
            if not matches:
                raise UserError(f"data.{split}: no sequence '{pattern}'{nearest(pattern, names)}; there is {', '.join(names)}")
            chosen |= dict.fromkeys(matches, split)
    if not ood:
        chosen |= {name: "ood" for name in names if name not in chosen and name.lower().startswith("ood")}
    left = [name for name in names if name not in chosen]
    if not test and len(left) > 1:
        count = max(1, round(_TEST_SHARE * len(left)))
        chosen |= dict.fromkeys(left[-count:], "test")
    if not set(names) - set(chosen):
        raise UserError(f"no sequence is left to train on: {', '.join(names)} are all held out; give fewer in data.test")
    return {name: chosen.get(name, "train") for name in names}
