"""Versions, compilation, and the ceilings that everything else is measured by: copies, matrix products, launches."""

from __future__ import annotations

import os
import statistics
import tempfile
import time

import torch
from released_kernels import SOURCE

from gpu_checks.context import Context
from snarfcli.native import cuda, cuda_compile
from snarfcli.native.library import instruction_set, why_unavailable
from snarfcli.precision import network_precision
from snarfcli.runs import machine_facts

__all__ = ["run"]


def run(context: Context) -> None:
    """Report versions, compile all kernels, measure the ceilings."""
    facts = machine_facts()
    native = instruction_set() or why_unavailable()
    context.section.say(
        f"{cuda.cuda_status()}. CUDA of PyTorch: {torch.version.cuda}; driver: {_driver()}; native CPU library: {native};",
        f"{facts['machine']['processor']}, {facts['machine']['cores']} cores;",
        ", ".join(f"{name} {version}" for name, version in facts["versions"].items()) + ".",
    )
    _compile_all(context)
    _ceilings(context)


def _driver() -> str:
    """Return the version of the NVIDIA driver, as far as the system tells it."""
    try:
        with open("/proc/driver/nvidia/version") as file:
            return file.readline().split("Kernel Module")[-1].split()[0]
    except (OSError, IndexError):
        return "not known"


def _compile_all(context: Context) -> None:
    """Compile every kernel for this device, without and with the cache."""
    if context.device.type == "cuda":
        architecture = cuda_compile.architecture_for(torch.cuda.get_device_capability(context.device))
    else:
        architecture = "sm_90"
    names = sorted(path.stem for path in (cuda_compile.cuda_sources() / "cuda").glob("*.cu"))
    rows, before = [], os.environ.get("XDG_CACHE_HOME")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        try:
            for source in [*names[: context.size(len(names), 1)], SOURCE]:
                seconds = []
                for _ in range(2):
                    start = time.perf_counter()
                    code = cuda_compile.load_kernels(source, torch.float32, architecture)
                    seconds.append(time.perf_counter() - start)
                name = source if isinstance(source, str) else source.stem
                rows.append([name, f"{len(code) // 1024}", f"{seconds[0]:.2f}", f"{1000 * seconds[1]:.1f}"])
                context.section.number(f"compile/{name}/s", seconds[0])
        finally:
            if before is None:
                del os.environ["XDG_CACHE_HOME"]
            else:
                os.environ["XDG_CACHE_HOME"] = before
    context.section.say(f"Kernels compiled for {architecture}, float32:")
    context.section.table(["source", "kB", "first time, s", "from the cache, ms"], rows)


def _ceilings(context: Context) -> None:
    """Measure the bandwidth of a copy, the rates of matrix products, and the time of a launch."""
    rows = []
    source = torch.randint(0, 255, (context.size(1 << 30, 1 << 20),), dtype=torch.uint8, device=context.device)
    target = torch.empty_like(source)
    copy = context.clock.in_turns({"copy": lambda: target.copy_(source)}, context.size(20, 2))["copy"]
    bandwidth = 2 * source.numel() / (copy.median / 1000) / 1e12
    rows.append(["copy, read and written", f"{bandwidth:.2f} TB/s"])
    context.section.number("ceiling/copy/TB/s", bandwidth)
    size = context.size(8192, 128)
    a, b = (torch.randn(size, size, device=context.device) for _ in range(2))
    for name, precision in (("float32", "highest"), ("TF32", "high"), ("bfloat16", "bfloat16")):
        with network_precision(precision, context.device):
            x, y = (a.bfloat16(), b.bfloat16()) if name == "bfloat16" else (a, b)
            ms = context.clock.in_turns({name: lambda x=x, y=y: x @ y}, context.size(5, 2))[name].median
        rate = 2 * size**3 / (ms / 1000) / 1e12
        rows.append([f"matrix product, {name}", f"{rate:.1f} TFLOP/s"])
        context.section.number(f"ceiling/{name}/TFLOP/s", rate)
    small = torch.zeros(32, device=context.device)
    rows.append(["launches of a small kernel, each", f"{_launch_us(context, small):.1f} us"])
    works = {"graph": lambda: [small.add_(1) for _ in range(100)]}
    in_graph = context.clock.in_turns(works, context.size(20, 2), captured=("graph",))["graph"]
    rows.append(["the same in a CUDA graph", f"{10 * in_graph.median:.1f} us"])
    context.section.table(["ceiling", "measured"], rows)


def _launch_us(context: Context, small: torch.Tensor) -> float:
    """Return the microseconds of one of many launches, median of five rounds."""
    count = context.size(1000, 10)
    rounds = [context.clock.once(lambda: [small.add_(1) for _ in range(count)]) for _ in range(5)]
    return 1e6 * statistics.median(rounds) / count
