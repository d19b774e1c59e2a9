"""The readers that are fed with broken files, one function each; what they need is imported only when one is called.

To add a reader, add a function with `@_target` anywhere below: its name is what `tools/fuzz_readers.py --only` takes.
"""

from __future__ import annotations

from collections.abc import Callable

from fuzzing import Target

__all__ = ["TARGETS"]

TARGETS: list[Callable[[], Target]] = []
"""Each makes one target, of the function's name."""


def _target(make: Callable[[], Target]) -> Callable[[], Target]:
    TARGETS.append(make)
    return make


@_target
def npz() -> Target:
    import io

    import numpy as np

    from snarfcli.files import read_npz

    def seeds() -> list[bytes]:
        made = []
        for save in (np.savez, np.savez_compressed):
            buffer = io.BytesIO()
            save(buffer, poses=np.linspace(0, 1, 12).reshape(2, 6), gender=np.array("neutral"), trans=np.zeros((2, 3), "f4"))
            made.append(buffer.getvalue())
        return made

    return Target("npz", ".npz", seeds, read_npz)
