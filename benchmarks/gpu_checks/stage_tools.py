"""Tests on the GPU, compute-sanitizer and ncu, each as a process of its own."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from released_kernels import SOURCE

from gpu_checks import small_run
from gpu_checks.context import Context
from gpu_checks.kernel_times import report_kernels
from gpu_checks.runner import Ending, run_limited
from gpu_checks.tools import COUNTERS, counter_rows, find_tool, kernel_names, sanitizer_findings
from snarfcli.native.cuda_compile import cuda_sources

__all__ = ["run_counters", "run_sanitizers", "run_tests"]

_ROOT = Path(__file__).resolve().parents[2]
_TOOLS = ("memcheck", "racecheck", "initcheck")
_KINDS = ("passed", "failed", "error", "skipped", "deselected")


def run_tests(context: Context) -> None:
    """Run the tests that are marked as running on a GPU; in a dry run, only collect them."""
    # Only files that ask for a GPU: others may need packages that are not installed.
    files = [path for path in sorted((_ROOT / "tests").rglob("test_*.py")) if "torch.cuda.is_available()" in path.read_text()]
    names = [str(path.relative_to(_ROOT)) for path in files]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "gpu", *names]
    command += ["--collect-only"] if context.tiny else []
    ending, output = _run(context, "pytest", command, context.left - 5)
    lines = [line for line in output.splitlines() if line.strip()]
    counts = {kind: sum(int(n) for n in re.findall(rf"(\d+) {kind}", lines[-1] if lines else "")) for kind in _KINDS}
    context.section.table(["exit code", *_KINDS, "s"], [[ending.status, *counts.values(), f"{ending.seconds:.0f}"]])
    broken = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
    if broken:
        context.section.say("```text\n" + "\n".join(broken[:40]) + "\n```")
    if not context.tiny:
        wrong = counts["failed"] + counts["error"]
        is_known = (ending.status == "done" or wrong) and counts["passed"]  # a run of no tests is no success
        context.section.goal("tests", wrong if is_known else float("nan"), f"{counts['passed']} passed, {ending.status}")


def run_sanitizers(context: Context) -> None:
    """Run the small program under compute-sanitizer's checkers; in a dry run, alone."""
    sanitizer = find_tool("compute-sanitizer")
    program = _small(context, context.size(300, 30))
    # so that each tensor is an allocation of its own, beyond which nothing may be read
    environment = os.environ | {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
    plain, output = _run(context, "small run", program, context.left / 4, environment)
    rows, total = [["none", plain.status, "", "", f"{plain.seconds:.0f}"]], 0.0
    if plain.status != "done":
        print(output[-3000:])
    for number, tool in enumerate(_TOOLS if sanitizer else ()):
        share = (context.left - 3) / (len(_TOOLS) - number)
        command = [str(sanitizer), "--tool", tool, "--error-exitcode", "99", "--print-limit", "20", *program]
        ending, output = _run(context, tool, command, share, environment)
        errors, kernels = sanitizer_findings(output)
        total += float("nan") if errors is None else errors
        places = ", ".join(f"{name}: {count}" for name, count in kernels.most_common(6))
        rows.append([tool, ending.status, "no summary" if errors is None else str(errors), places, f"{ending.seconds:.0f}"])
        if errors:
            context.section.say(f"{tool}:\n\n```text\n{output[-1500:]}\n```")
    context.section.table(["tool", "ended", "errors", "in kernels", "s"], rows)
    if sanitizer:
        context.section.goal("sanitizers", total, ", ".join(_TOOLS))
    else:
        context.section.say("compute-sanitizer was not found.")


def run_counters(context: Context) -> None:
    """Time the search kernels one by one, and read their hardware counters with ncu, which leaves the clocks alone.

    Without ncu the program runs alone.
    """
    report_kernels(context)
    ncu = find_tool("ncu")
    names = kernel_names(SOURCE) + [n for path in sorted((cuda_sources() / "cuda").glob("*.cu")) for n in kernel_names(path)]
    command = _small(context, context.size(100_000, 30), "--only-search")
    if ncu:
        options = ["--clock-control", "none", "--csv", "--page", "raw", "--target-processes", "all", "--launch-count", "60"]
        chosen = ["--kernel-name", f"regex:^({'|'.join(names)})$", "--metrics", ",".join(COUNTERS)]
        command = [ncu, *options, *chosen, *command]
    ending, output = _run(context, "ncu", command, context.left - 3)
    rows = counter_rows(output)
    if rows:
        context.section.table(["kernel", *COUNTERS.values()], rows)
    else:
        why = f"ncu gave no counters ({ending.status})" if ncu else f"ncu was not found; without it: {ending.status}"
        context.section.say(why + ":", "\n\n```text\n" + output[-1500:] + "\n```")


def _small(context: Context, queries: int, *more: str) -> list[str]:
    script = Path(str(small_run.__file__))
    places = ["--device", context.device.type, "--pack", str(context.pack)]
    return [sys.executable, str(script), *places, "--queries", str(queries), *more]


def _run(
    context: Context, name: str, command: Sequence[str], seconds: float, environment: dict[str, str] | None = None
) -> tuple[Ending, str]:
    """Run a command from the root of the checkout with a time limit, and return its ending and its output."""
    log = context.work / f"{name.replace(' ', '_')}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    log.write_text("")
    given = (os.environ if environment is None else environment) | {"PYTHONPATH": _with_root()}
    ending = run_limited(command, max(seconds, 2.0), log, given, _ROOT)
    return ending, log.read_text(errors="replace")


def _with_root() -> str:
    before = os.environ.get("PYTHONPATH")
    return os.pathsep.join([str(_ROOT), *([before] if before else [])])
