"""Times of the single kernels of a work, by PyTorch's profiler."""

from __future__ import annotations

from collections.abc import Callable

from torch.profiler import ProfilerActivity, profile

from gpu_checks.context import Context
from gpu_checks.scene_cases import NEAR

__all__ = ["report_kernels"]

_MOST_ROWS = 12
_CALLS = 5


def report_kernels(context: Context) -> None:
    """Report the kernels of the searches; on a CPU, the operators."""
    for pose, cells in (("knees", NEAR), ("deep_squats", NEAR)):
        case = context.scenes.case(pose, cells, context.size(200_000, 100))
        capacity = case.capacity()
        context.section.say(f"Kernels of a search of {case.points.shape[1]:,} queries, {case.name}, and of the released one:")
        works = (lambda case=case, capacity=capacity: case.complete(capacity), case.released)
        rows = [row for work in works for row in _kernel_rows(context, work)]
        context.section.table(["kernel", "launches", "us, all launches"], rows)


def _kernel_rows(context: Context, work: Callable[[], object]) -> list[list[str]]:
    """Return a row for each kernel in one call of the work, the longest first, means of some calls."""
    work()
    context.clock.wait()
    is_gpu = context.device.type == "cuda"
    with profile(activities=[ProfilerActivity.CUDA if is_gpu else ProfilerActivity.CPU]) as profiled:
        for _ in range(_CALLS):
            work()
        context.clock.wait()
    events = [
        (event.self_device_time_total if is_gpu else event.self_cpu_time_total, event) for event in profiled.key_averages()
    ]
    events = sorted((event for event in events if event[0] > 0), key=lambda event: -event[0])
    return [[event.key[:60], f"{event.count / _CALLS:g}", f"{us / _CALLS:.1f}"] for us, event in events[:_MOST_ROWS]]
