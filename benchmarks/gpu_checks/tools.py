"""NVIDIA's command-line tools: where they are, and what their output says."""

from __future__ import annotations

import csv
import io
import re
import shutil
from collections import Counter
from pathlib import Path

__all__ = ["COUNTERS", "counter_rows", "find_tool", "kernel_names", "sanitizer_findings"]

COUNTERS = {
    "gpu__time_duration.sum": "us",
    "sm__throughput.avg.pct_of_peak_sustained_elapsed": "compute, %",
    "gpu__compute_memory_throughput.avg.pct_of_peak_sustained_elapsed": "memory, %",
    "dram__throughput.avg.pct_of_peak_sustained_elapsed": "DRAM, %",
    "sm__warps_active.avg.pct_of_peak_sustained_active": "warps active, %",
    "smsp__thread_inst_executed_per_inst_executed.ratio": "threads of a warp",
    "launch__registers_per_thread": "registers",
}
"""The hardware counters that are read, and their names in the report."""

_NANOSECONDS = {"nsecond": 1.0, "ns": 1.0, "usecond": 1e3, "us": 1e3, "msecond": 1e6, "ms": 1e6, "second": 1e9, "s": 1e9}


def find_tool(name: str) -> str | None:
    """Return the path of a tool of the CUDA toolkit, or None."""
    folders = [*sorted(Path("/opt/nvidia/nsight-compute").glob("*"), reverse=True), Path("/usr/local/cuda/bin")]
    return shutil.which(name) or next((found for folder in folders if (found := shutil.which(name, path=str(folder)))), None)


def kernel_names(source: Path) -> list[str]:
    """Return the names of the kernels in a CUDA source."""
    return re.findall(r'extern "C" __global__ void [^;{]*?\b(\w+)\(const', source.read_text())


def sanitizer_findings(output: str) -> tuple[int | None, Counter[str]]:
    """Return the number of errors that compute-sanitizer reports, None without a summary, and how many it places in kernels."""
    totals = re.findall(r"(?:ERROR|RACECHECK) SUMMARY: (\d+) (?:error|hazard)", output)
    place = r"^=========.*?\bat (?:0x[0-9a-f]+ in )?(?!0x)([\w:<>, ]+?)(?:[(+]|$)"
    kernels = Counter(re.findall(place, output, re.MULTILINE))
    return (int(totals[-1]) if totals else None), kernels


def counter_rows(output: str) -> list[list[str]]:
    """Return a row of text for each kernel that ncu has profiled, with the columns kernel and `COUNTERS`.

    Args:
        output: of `ncu --csv --page raw`; lines that are not part of the table are skipped.
    """
    lines = [line for line in output.splitlines() if line.startswith('"')]
    if len(lines) < 3:
        return []
    header, units, *kernels = csv.reader(io.StringIO("\n".join(lines)))
    rows = []
    for values in kernels:
        named, unit_of = dict(zip(header, values, strict=False)), dict(zip(header, units, strict=False))
        cells = [_counter(named.get(name, ""), unit_of.get(name, ""), shown) for name, shown in COUNTERS.items()]
        rows.append([named.get("Kernel Name", "?").split("(")[0], *cells])
    return rows


def _counter(text: str, unit: str, shown: str) -> str:
    """Return a counter's value, times in microseconds; "-" without a value."""
    try:
        value = float(text.replace(",", ""))
    except ValueError:
        return "-"
    return f"{value * _NANOSECONDS.get(unit, 1.0) / 1000:.1f}" if shown == "us" else f"{value:.4g}"
