"""All stages in their order, with their time limits. The longest is last, so that it gets all time that is left."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

from gpu_checks.context import Context
from gpu_checks.runner import Stage

__all__ = ["STAGES", "stage_function"]

# name, title, time limit in seconds, and the function
_TABLE = (
    ("machine", "Versions, compilation and ceilings", 60, "stage_machine:run"),
    ("correct", "Beside the CPU library", 45, "stage_correct:run"),
    ("search", "Search, beside the released algorithm", 60, "stage_search:run"),
    ("gradient", "Gradient", 30, "stage_search:run_gradient"),
    ("field", "Network and whole query", 60, "stage_field:run"),
    ("meshes", "Meshes and evaluation", 60, "stage_meshes:run"),
    ("quick", "Training: quick", 90, "stage_training:run_quick"),
    ("tests", "Tests on the GPU", 100, "stage_tools:run_tests"),
    ("sanitizers", "Sanitizers", 100, "stage_tools:run_sanitizers"),
    ("counters", "Kernels and hardware counters", 60, "stage_tools:run_counters"),
    ("memory", "Peak memory", 40, "stage_memory:run"),
    ("paper", "Training: paper", 420, "stage_training:run_paper"),
)

STAGES = tuple(Stage(name, title, seconds) for name, title, seconds, _ in _TABLE)
"""The stages in the order in which they run."""


def stage_function(name: str) -> Callable[[Context], None]:
    """Return the function of a stage. Only the chosen stage's packages are imported."""
    place = next(place for stage, _, _, place in _TABLE if stage == name)
    module, function = place.split(":")
    return getattr(import_module(f"gpu_checks.{module}"), function)
