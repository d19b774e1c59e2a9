"""Do the same work many times and report whether memory and open files grow: the long form of `tests/test_steady_work.py`.

    python tools/trust_memory.py
    python tools/trust_memory.py --only preprocess animate

Prints the resident memory and the number of open files of the process after 10, 50 and 100 % of the work, and the memory of
20 million points in one call of `Avatar.occupancy`. Linux only; about half an hour on one core. The exit code is 1 if something
grows.
"""

from __future__ import annotations

import argparse
import logging
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import torch
from steady_work import AVATAR, WORK, resident_bytes, watch

from snarfcli import Avatar

_MIB = 2**20
# Between 10 and 100 % of the work. A leak of one kilobyte per call is 9 MiB in 10,000 calls, of one picture per frame far more;
# the memory of a process without a leak differs by up to 5 MiB.
_MOST_GROWTH = 8 * _MIB
_AT_ONCE = "20 million points"
_MOST_AT_ONCE = 1024 * _MIB


def main() -> int:
    names = [*WORK, _AT_ONCE]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=names, help=f"kinds of work: {', '.join(names)}")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    chosen = options.only or names
    if options.child:
        return _at_once() if chosen == [_AT_ONCE] else _many_times(chosen[0])
    codes = [subprocess.run([sys.executable, __file__, "--child", "--only", name]).returncode for name in chosen]
    return 1 if any(codes) else 0


def _many_times(name: str) -> int:
    """Do one kind of work and print what it used; return 1 if that grows."""
    logging.disable()
    work, count = WORK[name]
    with tempfile.TemporaryDirectory() as folder:
        seen = watch(work, count, Path(folder))
    print(f"{name}, {count:,} times", flush=True)
    for usage in seen:
        print(f"  {usage.share:4.0%}: {usage.memory / _MIB:6.1f} MiB, {usage.handles} open files")
    first, last = seen[0], seen[-1]
    return _verdict(last.memory - first.memory <= _MOST_GROWTH and last.handles <= first.handles)


def _at_once() -> int:
    """Ask for 20 million points in one call and print the most memory meanwhile; return 1 if it is too much."""
    avatar = Avatar.load(AVATAR)
    joints = avatar.skeleton.canonical_joints
    generator = torch.Generator().manual_seed(0)
    pose = torch.zeros(1, len(joints), 3)
    avatar.occupancy(joints[None], pose)
    points = joints[torch.randint(len(joints), (20_000_000,), generator=generator)]
    points += 0.05 * torch.randn(points.shape, generator=generator)
    before, most, ended = resident_bytes(), 0, threading.Event()

    def look() -> None:
        nonlocal most
        while not ended.wait(0.01):
            most = max(most, resident_bytes())

    watcher = threading.Thread(target=look)
    watcher.start()
    inside = avatar.occupancy(points[None], pose) > 0.5
    ended.set()
    watcher.join()
    needed = most - before
    print(f"{_AT_ONCE} in one call, {inside.float().mean():.0%} inside: {needed / _MIB:.0f} MiB more", flush=True)
    return _verdict(needed <= _MOST_AT_ONCE)


def _verdict(is_steady: bool) -> int:
    print("  steady" if is_steady else "  GROWS", flush=True)
    return 0 if is_steady else 1


if __name__ == "__main__":
    sys.exit(main())
