"""Commands whose disk fails at a chosen operation, in forked processes: modules are loaded once for hundreds of runs.

The process that forks must run with the library of `fault_shim.c` preloaded; `python -m pytest` is started anew for that, see
`preloaded`.
"""

from __future__ import annotations

import ctypes
import errno
import importlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass
from pathlib import Path

from trust.outputs import content_of, differences
from trust.scenarios import SCENARIOS, Scenario

__all__ = ["FAULTS", "Bench", "Ended", "build_shim", "preloaded_environment", "restart_preloaded"]

KILL = -9
FAULTS = {"kill": (KILL, False), "full": (errno.ENOSPC, True), "io": (errno.EIO, False)}
"""What happens at the operation: error number (or KILL), and whether it lasts."""
# 0: what failed was not needed, such as who holds a lock; with kill, 2: it was a program that the command had started.
_ALLOWED_CODES = {"kill": (-signal.SIGKILL, 2), "full": (0, 2), "io": (0, 2)}
_PATIENCE_S = 300.0
_SHIM = Path(__file__).with_name("fault_shim.c")


def build_shim(folder: Path) -> Path | None:
    """Compile the library; None if there is no compiler, or the system is not Linux."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None or not sys.platform.startswith("linux"):
        return None
    library = folder / "libfaults.so"
    subprocess.run([compiler, "-O1", "-shared", "-fPIC", "-o", str(library), str(_SHIM), "-ldl"], check=True)
    return library


def restart_preloaded() -> None:
    """Start this program again with the library that lets files fail, unless it has it; exit with 2 if that is impossible."""
    if os.environ.get("FAULTS_READY") == "1":
        return
    with tempfile.TemporaryDirectory(prefix="snarf-shim-") as folder:
        library = build_shim(Path(folder))
        if library is None:
            print("needs Linux and a C compiler", file=sys.stderr)
            sys.exit(2)
        sys.exit(subprocess.call([sys.executable, *sys.argv], env=preloaded_environment(library)))


def preloaded_environment(library: Path) -> dict[str, str]:
    """Return the environment of a process whose files can fail."""
    tests = str(Path(__file__).parents[1])
    paths = [tests, *filter(None, [os.environ.get("PYTHONPATH")])]
    more = {"LD_PRELOAD": str(library), "FAULTS_READY": "1", "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    return {**os.environ, **more, "PYTHONPATH": os.pathsep.join(paths)}


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    """Exit code, or the negative number of a signal."""
    said: str
    """Standard error."""
    operations: int
    """Number of operations of its processes so far."""


class Bench:
    """Runs scenarios in one folder, from the same state each time.

    Args:
        folder: an empty folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()
        self.work = self.folder / "work"
        self._library = ctypes.CDLL(None)
        self._expected: dict[str, dict[str, str]] = {}
        for name in ("cli.main", *(f"commands.{name}" for name in ("preprocess", "train", "evaluate", "animate", "export"))):
            importlib.import_module(f"snarfcli.{name}")

    def operations(self, scenario: Scenario) -> int:
        """Run a scenario without a fault; keep what it wrote as what is expected, and return the number of its operations."""
        self._start_over(scenario)
        ended = self.run(scenario)
        if ended.code != 0:
            raise RuntimeError(f"{scenario.name} ended with {ended.code}: {ended.said}")
        self._expected[scenario.name] = content_of(self.work)
        return ended.operations

    def problems(self, scenario: Scenario, fault: str, at: int) -> list[str]:
        """Run a scenario with a fault, and again without; return what was wrong, one line each.

        Args:
            scenario: after a call of `operations` with it.
            fault: one of `FAULTS`.
            at: number of the operation with the fault.
        """
        self._start_over(scenario)
        expected = self._expected[scenario.name]
        first = self.run(scenario, fault, at)
        wrong = []
        if first.code not in _ALLOWED_CODES[fault]:
            wrong.append(f"exit code {first.code}: {first.said[-500:]}")
        lines = [line for line in first.said.splitlines() if line.strip()]
        if first.code > 0 and len(lines) != 1:
            wrong.append(f"wanted one line, got {len(lines)}: {first.said[-1000:]}")
        there = content_of(self.work)
        is_done = not differences({name: one for name, one in there.items() if name in expected}, expected)
        again = self.run(scenario)
        if again.code != 0 and not (is_done and again.code == 2 and " already; give overwrite=true " in again.said):
            wrong.append(f"the second run ended with {again.code}: {again.said[-500:]}")
        return wrong + differences(content_of(self.work), expected)

    def pair_problems(self, scenario: Scenario, delay_s: float, *more: str) -> list[str]:
        """Run a scenario twice at the same time; return what was wrong, one line each.

        Args:
            scenario: after a call of `operations` with it.
            delay_s: time between the two starts.
            more: further arguments of both.
        """
        self._start_over(scenario)
        places = [self.folder / f"said{number}" for number in range(2)]
        first = self._start(scenario, places[0], more=more)
        time.sleep(delay_s)
        second = self._start(scenario, places[1], more=more)
        wrong = []
        for number, (process, said) in enumerate(zip((first, second), places, strict=True)):
            ended = self._end(process, said)
            refused = ended.code == 2 and re.search(r" is in use by | already; give overwrite=true ", ended.said)
            if ended.code != 0 and not (refused and len(ended.said.strip().splitlines()) == 1):
                wrong.append(f"command {number + 1} of 2 ended with {ended.code}: {ended.said[-500:]}")
        return wrong + differences(content_of(self.work), self._expected[scenario.name])

    def run(self, scenario: Scenario, fault: str = "kill", at: int = 0) -> Ended:
        """Run a scenario in a forked process, and wait for it."""
        said = self.folder / "said"
        (self.folder / "counter").unlink(missing_ok=True)
        return self._end(self._start(scenario, said, fault, at), said)

    def _start(self, scenario: Scenario, said: Path, fault: str = "kill", at: int = 0, more: tuple[str, ...] = ()) -> int:
        process = os.fork()
        if process == 0:
            self._run_here((*scenario.arguments, *more), said, at, *FAULTS[fault])
        return process

    def _end(self, process: int, said: Path) -> Ended:
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        number = int.from_bytes((self.folder / "counter").read_bytes()[:8], sys.byteorder)
        return Ended(code, said.read_text(errors="replace"), number)

    def _run_here(self, arguments: tuple[str, ...], said: Path, at: int, error: int, lasting: bool) -> None:
        """Run a command in this process, and end it."""
        code, counter = 1, self.folder / "counter"
        try:
            os.chdir(self.work)
            for stream, place in ((1, self.folder / "printed"), (2, said)):
                os.dup2(os.open(place, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), stream)
            sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
            os.environ |= {
                "FAULT_FOLDER": str(self.work), "FAULT_AT": str(at), "FAULT_ERROR": str(error),
                "FAULT_LASTING": str(int(lasting)), "FAULT_COUNTER": str(counter),
            }  # fmt: skip
            self._library.fault_arm(str(self.work).encode(), ctypes.c_long(at), error, int(lasting), str(counter).encode())
            from snarfcli.cli.main import main

            code = main(list(arguments))
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)

    def _start_over(self, scenario: Scenario) -> None:
        """Put the working folder into the state before a scenario, which is made at first."""
        shutil.rmtree(self.work, ignore_errors=True)
        before = self.folder / "before" / "-".join(scenario.needs or ("nothing",))
        if not before.exists():
            self.work.mkdir(parents=True)
            for name in scenario.needs:
                ended = self.run(SCENARIOS[name])
                if ended.code != 0:
                    raise RuntimeError(f"{name} ended with {ended.code}: {ended.said}")
            shutil.copytree(self.work, before)
        else:
            shutil.copytree(before, self.work)
