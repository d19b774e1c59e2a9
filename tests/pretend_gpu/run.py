"""Run Python code in a process that has a pretend GPU."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import textwrap
from dataclasses import dataclass
from pathlib import Path

from pretend_gpu.build import build_library, why_no_pretend_gpu
from pretend_gpu.seen import Seen

__all__ = ["Report", "run_on_pretend_gpu"]

_START = Path(__file__).with_name("start.py")


@dataclass
class Report:
    """What a program did on the pretend GPU."""

    output: str
    """All that it printed."""
    seen: list[Seen]
    """Events of each `watch`, in the order in which these ended."""

    def __getitem__(self, name: str) -> Seen:
        """Return the events of the only watch of a name."""
        (found,) = [seen for seen in self.seen if seen.name == name]
        return found


def run_on_pretend_gpu(code: str, *arguments: str | Path, emulated: bool = False, timeout_s: float = 300) -> Report:
    """Run Python code, which may be indented, in a process of its own with a pretend GPU; skip the test where there is none.

    The code uses the device as `from pretend_gpu.device import CUDA, watch` and finds `arguments` in `sys.argv[1:]`.
    With `emulated`, operators of ours run their CUDA kernels, compiled as C++, instead of those for the CPU: slower, with the
    true numbers of kernels and waits.

    Raises:
        AssertionError: the code failed; the message has its output.
    """
    if (reason := why_no_pretend_gpu()) is not None:
        import pytest  # here, so that benchmarks need it only to skip nothing

        pytest.skip(reason)
    with tempfile.TemporaryDirectory() as folder:
        program, report = Path(folder) / "program.py", Path(folder) / "report.jsonl"
        program.write_text(textwrap.dedent(code))
        report.touch()
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join([str(_START.parents[1]), *filter(None, sys.path)]),
            "SNARF_PRETEND_GPU_REPORT": str(report),
            "SNARF_PRETEND_GPU_EMULATED": str(int(emulated)),
        }
        command = [sys.executable, str(_START), str(build_library()), str(program), *map(str, arguments)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=timeout_s)
        assert done.returncode == 0, f"exit code {done.returncode}\n{done.stdout}\n{done.stderr}"
        return Report(done.stdout, Seen.read_all(report))
