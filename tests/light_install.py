"""Run code as where snarf is installed without extras: PyTorch, NumPy and what these need are the only packages."""

from __future__ import annotations

import re
import subprocess
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, packages_distributions, requires

__all__ = ["hidden_modules", "run_light"]

_START = """
import sys


class WithoutExtras:
    def __init__(self, finder):
        self.finder = finder

    def find_spec(self, name, path=None, target=None):
        return None if name.partition(".")[0] in HIDDEN else self.finder.find_spec(name, path, target)

    def __getattr__(self, name):
        return getattr(self.finder, name)


sys.meta_path[:] = [WithoutExtras(finder) for finder in sys.meta_path]
"""


def run_light(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python code in a process that finds no package but PyTorch, NumPy and what these need."""
    command = [sys.executable, "-c", f"HIDDEN = {hidden_modules()!r}{_START}{code}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


@cache
def hidden_modules() -> set[str]:
    """Return the installed top-level modules that neither snarf without extras nor its dependencies bring."""
    light = {"snarf"} | _with_dependencies("torch") | _with_dependencies("numpy")
    return {module for module, owners in packages_distributions().items() if light.isdisjoint(map(_normal, owners))}


def _with_dependencies(package: str) -> set[str]:
    """Return a package and all that it needs without extras, by their normal names."""
    found: set[str] = set()
    waiting = [package]
    while waiting:
        name = _normal(waiting.pop())
        if name in found:
            continue
        found.add(name)
        try:
            needs = requires(name) or []
        except PackageNotFoundError:  # for another platform
            continue
        waiting += [re.split(r"[^\w.-]", need, maxsplit=1)[0] for need in needs if not re.search(r"\bextra\s*==", need)]
    return found


def _normal(package: str) -> str:
    return re.sub(r"[-_.]+", "-", package).lower()
