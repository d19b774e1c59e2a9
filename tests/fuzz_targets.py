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


@_target
def bvh() -> Target:
    from snarfcli.formats.bvh import read_bvh

    def seeds() -> list[bytes]:
        end = "End Site {{ OFFSET 0 {} 0 }} }}"
        arm = "JOINT Arm { OFFSET 0 9 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n" + end.format(1)
        leg = "JOINT Leg { OFFSET 1.5 -8 0\nCHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation\n"
        leg += end.format(-1)
        root = "HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n"
        values = " ".join(str(number / 4) for number in range(15))
        motion = "MOTION\nFrames: 3\nFrame Time: 0.0083333\n"
        return [
            f"{root}{arm}\n{leg}\n}}\n{motion}{values}\n{values}\n{values}\n".encode(),
            f"{root}{arm}\n}}\n{motion}".replace("\n", "\r\n").encode() + b"1 2 3 4 5 6 7e0 8 -9.5\r\n" * 3,
            f"{root}}}\n".encode() + b"MOTION\nFrames: 40\nFrame Time: 0\n" + b"0 90 0 0 0 45\n" * 40,
        ]

    return Target("bvh", ".bvh", seeds, read_bvh)
