"""Resolve snarf's packages for every Python and platform from wheels, and write the table docs/platforms.md.

    python tools/platforms.py           # writes the table; needs uv (pip install uv) and a package index, takes minutes
    python tools/platforms.py --check   # ends with exit code 1 if a cell that resolves in the table does not any more

Nothing is downloaded but descriptions of packages, and nothing is installed.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "docs" / "platforms.md"
PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
SOURCE_ONLY = ("antlr4-python3-runtime",)  # of hydra-core and omegaconf: plain Python, which pip builds on any machine
SHOWN = ("torch", "numpy", "scipy", "libigl", "pymeshlab", "embreex")
PATIENCE_S = 300


@dataclass(frozen=True)
class Platform:
    """A column of the table."""

    title: str
    target: str
    """Name of the platform for uv."""


PLATFORMS = (
    Platform("Linux x86-64", "x86_64-manylinux_2_35"),
    Platform("Linux ARM", "aarch64-manylinux_2_35"),
    Platform("macOS ARM", "aarch64-apple-darwin"),
    Platform("Windows", "x86_64-pc-windows-msvc"),
    Platform("Linux x86-64, glibc 2.28", "x86_64-manylinux_2_28"),
)
EXTRAS = ("", "commands", "commands-without-gpl")


@dataclass(frozen=True)
class Cell:
    """What resolving gives for one set of packages, Python and platform."""

    versions: dict[str, str]
    """Version of each package, by name; empty if it does not resolve."""
    reason: str
    """Why it does not resolve."""


def main() -> int:
    """Write the table, or compare it with what resolves now."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare with the table instead of writing it")
    parser.add_argument("--uv", default=shutil.which("uv") or str(Path(sys.executable).with_name("uv")), help="the program uv")
    options = parser.parse_args()
    cells: dict[tuple[str, str, Platform], Cell] = {}
    for extra in EXTRAS:
        for python in PYTHONS:
            for platform in PLATFORMS:
                cell = cells[extra, python, platform] = resolve(options.uv, extra, python, platform)
                print(f"{extra or 'no extra':<22} {python:<5} {platform.title:<26} {cell.reason or 'resolves'}", flush=True)
    text = page(cells)
    if not options.check:
        TABLE.write_text(text, encoding="utf-8")
        return 0
    lost = lost_cells(TABLE.read_text(encoding="utf-8"), text)
    print("\n".join(["no longer resolves:", *lost] if lost else ["every cell of the table resolves as before"]))
    return 1 if lost else 0


def resolve(uv: str, extra: str, python: str, platform: Platform) -> Cell:
    """Return the newest packages that fit, from wheels only."""
    command = [uv, "pip", "compile", "--quiet", "--no-header", "--no-annotate", "--only-binary", ":all:"]
    for package in SOURCE_ONLY:
        command += ["--no-binary", package]
    command += ["--python-version", python, "--python-platform", platform.target, *(["--extra", extra] if extra else [])]
    done = subprocess.run([*command, str(ROOT / "pyproject.toml")], capture_output=True, text=True, timeout=PATIENCE_S)
    if done.returncode == 0:
        return Cell(dict(re.findall(r"^([\w.-]+)==(\S+)", done.stdout, re.MULTILINE)), "")
    return Cell({}, missing(done.stderr))


def missing(error: str) -> str:
    """Return the package that has no wheel, from what uv says; its first line for any other failure."""
    found = re.findall(r"(?:all versions of )?([a-z][\w-]*)\S* has no wheels with a matching", " ".join(error.split()))
    if not found:
        found = re.findall(r"([a-z][\w-]*)\S* have no wheels with a matching", " ".join(error.split()))
    names = [name for name in dict.fromkeys(found) if name not in ("and", "of")]
    return f"no wheel of {', '.join(names)}" if names else " ".join(error.split())[:200]


def page(cells: dict[tuple[str, str, Platform], Cell]) -> str:
    """Return the page: one table per set of packages, and the versions that were found."""
    parts = [INTRODUCTION]
    for extra in EXTRAS:
        parts.append(f"## {f'With the extra `{extra}`' if extra else 'Without extras: the deformer, bodies and networks'}")
        head = f"| Python | {' | '.join(platform.title for platform in PLATFORMS)} |"
        rows = [head, "|---|" + "---|" * len(PLATFORMS)]
        for python in PYTHONS:
            row = [cells[extra, python, platform] for platform in PLATFORMS]
            rows.append(f"| {python} | {' | '.join(cell.reason or 'yes' for cell in row)} |")
        parts.append("\n".join(rows))
    parts.append("## Versions, with the extra `commands-without-gpl` or, for pymeshlab, `commands`")
    rows = ["| Python | platform | " + " | ".join(SHOWN) + " |", "|---|---|" + "---|" * len(SHOWN)]
    for python in (PYTHONS[0], PYTHONS[-1]):
        for platform in PLATFORMS:
            versions = cells[EXTRAS[-1], python, platform].versions | cells["commands", python, platform].versions
            rows.append(f"| {python} | {platform.title} | {' | '.join(versions.get(name, '–') for name in SHOWN)} |")
    return "\n\n".join([*parts, "\n".join(rows)]) + "\n"


def lost_cells(before: str, now: str) -> list[str]:
    """Return the rows of the present page in which fewer cells resolve than in the stored one."""
    return [
        new
        for old, new in zip(table_rows(before), table_rows(now), strict=True)
        if any(a == "yes" != b for a, b in zip(old.split(" | "), new.split(" | "), strict=True))
    ]


def table_rows(text: str) -> list[str]:
    """Return the rows for each Python of the tables of a page."""
    return [line.strip("| ") for line in text.splitlines() if re.match(r"\| 3\.\d+ \| (?:yes|no )", line)]


INTRODUCTION = """# Platforms

Whether every package that snarf needs has a wheel, by `python tools/platforms.py` (`make platforms`): the newest versions
that fit together are resolved, and nothing is installed. The one exception is antlr4-python3-runtime, which Hydra needs: it
is plain Python without a wheel, and pip builds it on any machine. snarf itself is compiled when it is installed, or works
without its library.

pymeshlab (licence GPL-3) has wheels for Linux with glibc 2.35 (Ubuntu 22.04, Debian 12) and newer. On older systems, such
as RHEL 8 and 9, `pip install '.[commands-without-gpl]'` leaves it out; only `data=clothed` needs it. pymeshlab also needs
`libGL.so.1` and `libOpenGL.so.0` (Debian and Ubuntu: `apt install libgl1 libopengl0`); without them it is not used.
embreex has no wheels for Linux and Windows on ARM; there libigl traces the rays, four times slower.

The tests have been run on Linux x86-64 with Python 3.11, and parts of them with Python 3.10 and the oldest allowed packages
(`make lowest`). With Python 3.14.10, PyTorch 2.15.0, NumPy 2.5.5 and SciPy 1.18.1, on Debian sid (glibc 2.43, GCC 16.2)
without a GPU, `pip install '.[commands]'`, `doctor`, and `experiment=smoke` of `preprocess`, `train` (also `-m`), `eval`
(also `--ood`), `animate` and `export` (GLB, HTML, VRM, BVH) have been run, and the tests of the command line, launchers,
processes, files and locks: 202 passed. The other tests have not been run with Python 3.14 yet. macOS, Windows and ARM have
not been run yet by the authors; `.github/workflows` runs these systems.

Beside PyTorch and NumPy, the extra `commands` takes 900 MB, measured on Linux: pymeshlab 290, imageio-ffmpeg 170, SciPy 150,
Matplotlib 75, TensorBoard 57, embreex 46, libigl 43, scikit-image 37. `commands-without-gpl` takes 610 MB."""


if __name__ == "__main__":
    sys.exit(main())
