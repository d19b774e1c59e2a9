"""Helpers of all benchmarks: options, facts about the machine, timing with median and spread, tables."""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import torch

from snarfcli.runs import machine_facts

__all__ = [
    "Times",
    "arguments",
    "in_pytorch",
    "in_turns",
    "median_and_spread",
    "print_machine",
    "print_table",
    "resident_bytes",
    "timed",
]


def arguments(description: str, **extra: dict) -> argparse.Namespace:
    """Read the options that all benchmarks have, and `extra` ones (name: keywords of `add_argument`)."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--threads", type=int, default=None, help="threads of PyTorch (default: its own choice)")
    parser.add_argument("--repeats", type=int, default=5, help="timed repetitions; the median is reported")
    for name, keywords in extra.items():
        parser.add_argument(f"--{name.replace('_', '-')}", **keywords)
    options = parser.parse_args()
    if options.threads:
        torch.set_num_threads(options.threads)
    return options


def require(path: Path, command: str) -> Path:
    """Return `path`, or exit with a line that says how to make it."""
    if not path.exists():
        raise SystemExit(f"no {path}; make it with: {command}")
    return path


def timed(work: Callable[[], object], repeats: int) -> list[float]:
    """Return the seconds of `repeats` calls after a warm-up call."""
    work()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return seconds


@dataclass
class Times:
    """Medians of repeated calls, seconds."""

    wall: float
    """Elapsed time."""
    processor: float
    """Processor time of all threads, which other processes lengthen less."""

    def scaled(self, factor: float) -> Times:
        """Return the times of `factor` as many calls."""
        return Times(self.wall * factor, self.processor * factor)

    def over(self, other: Times) -> str:
        """Return the ratios of these times to others, elapsed and, in brackets, processor time."""
        return f"{self.wall / other.wall:.3g} ({self.processor / other.processor:.3g})"


def in_turns(works: Sequence[Callable[[], object]], repeats: int) -> list[Times]:
    """Return the times of several works, called one after the other again and again, after a warm-up call of each."""
    for work in works:
        work()
    wall: list[list[float]] = [[] for _ in works]
    processor: list[list[float]] = [[] for _ in works]
    for _ in range(repeats):
        for i, work in enumerate(works):
            start, used = time.perf_counter(), time.process_time()
            work()
            wall[i].append(time.perf_counter() - start)
            processor[i].append(time.process_time() - used)
    return [Times(statistics.median(a), statistics.median(b)) for a, b in zip(wall, processor, strict=True)]


@contextmanager
def in_pytorch() -> Iterator[None]:
    """Evaluate networks layer by layer in PyTorch instead of natively."""
    with ExitStack() as stack:
        for module in ("perceptron", "encoding", "capsules", "pose_code"):
            stack.enter_context(mock.patch(f"snarfcli.networks.{module}.choose_backend", return_value="reference"))
        yield


def median_and_spread(seconds: Sequence[float]) -> str:
    """Return median, minimum and maximum in milliseconds."""
    ms = [1000 * value for value in seconds]
    return f"{statistics.median(ms):.1f} ({min(ms):.1f}-{max(ms):.1f})"


def resident_bytes() -> int:
    """Return the memory of this process, after it returned to the system what it does not use."""
    gc.collect()
    with contextlib.suppress(AttributeError):  # not in every C library
        ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def print_machine() -> None:
    """Print the machine and the versions that the following numbers belong to."""
    facts = machine_facts(torch.device("cuda") if torch.cuda.is_available() else None)
    machine, versions = facts["machine"], facts["versions"]
    gpu = f", {machine['gpu']}" if "gpu" in machine else ""
    print(f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads{gpu}")
    print(", ".join(f"{name} {version}" for name, version in versions.items()))


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows of text as a Markdown table."""
    widths = [max(len(str(row[i])) for row in [header, *rows]) for i in range(len(header))]
    lines = [header, ["-" * width for width in widths], *rows]
    for line in lines:
        print("| " + " | ".join(str(cell).ljust(width) for cell, width in zip(line, widths, strict=True)) + " |")
