"""Lines of the report of `snarf doctor` about packages and programs: versions, whether they work, what stands in for them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

from snarfcli.commands.doctor_findings import Finding
from snarfcli.extras import why_not_imported
from snarfcli.extras.meshlab import MESHLAB_NEEDS, why_no_meshlab
from snarfcli.texts import one_line
from snarfcli.versions import installed_version

__all__ = ["EXTRAS", "TOOLS", "describe_error", "extras", "package_finding", "tools"]

TOOLS: dict[str, Callable[[], str | None]] = {
    "embreex": partial(why_not_imported, "embreex", "embreex.rtcore_scene"),
    "libigl": partial(why_not_imported, "libigl", "igl"),
    "pymeshlab": why_no_meshlab,
}
"""Compiled packages, and what says why one cannot be used."""
_INSTEAD = {
    "embreex": "libigl traces the rays, several times slower; there are no wheels for Linux on ARM",
    "pymeshlab": "snarf spreads the surface points (poisson=own) and libigl decimates; data=clothed needs it",
}
"""What is used where a package is missing."""
_NEEDS = {"pymeshlab": MESHLAB_NEEDS}
_LICENCES = {"pymeshlab": "licence GPL-3; can be left out: poisson=own, and libigl decimates"}

EXTRAS = {
    "view": ("viser", "snarf view"),
    "hub": ("huggingface-hub", "avatars of the Hugging Face Hub, Avatar.from_pretrained"),
    "blender": ("bpy", "snarf export format=fbx and usd, unless a blender is on the PATH"),
    "joblib": ("hydra-joblib-launcher", "several runs at a time, hydra/launcher=joblib"),
    "submitit": ("hydra-submitit-launcher", "runs on a cluster, launcher=submitit_slurm"),
}
"""Extras of single functions: the package that each brings, and what needs it."""


def tools() -> Iterator[Finding]:
    """Yield ffmpeg and the compiled packages."""
    yield _ffmpeg()
    for package, why_not in TOOLS.items():
        yield package_finding("embree" if package == "embreex" else package, package, why_not)


def extras() -> Iterator[Finding]:
    """Yield the extras of single functions. None is a fallback: what needs one says so when it is used."""
    for extra, (package, purpose) in EXTRAS.items():
        installed = installed_version(package)
        missing = f"not installed; for {purpose}: pip install 'snarf[{extra}]'"
        yield Finding(extra, missing if installed is None else f"{package} {installed}, for {purpose}")


def package_finding(name: str, package: str, why_not: Callable[[], str | None] | None = None) -> Finding:
    """Return the version of a package and, if `why_not` is given, which says why it cannot be used, whether it can."""
    installed = installed_version(package)
    instead = f"; {_INSTEAD[package]}" if package in _INSTEAD else ""
    if installed is None:
        return Finding(name, f'not installed{instead}; run "pip install {package}"', is_fallback=True)
    try:
        reason = why_not() if why_not is not None else None
    except Exception as error:
        reason = describe_error(error)
    if reason is not None:
        needs = f"; {_NEEDS[package]}" if package in _NEEDS else ""
        return Finding(name, f"{installed} cannot be used: {reason}{instead}{needs}", is_fallback=True)
    licence = f" ({_LICENCES[package]})" if package in _LICENCES else ""
    return Finding(name, f"{package} {installed}{licence}" if name != package else f"{installed}{licence}")


def describe_error(error: Exception) -> str:
    """Return the type and text of an error in one line."""
    return f"{type(error).__name__}: {one_line(error)}"


def _ffmpeg() -> Finding:
    """Return the ffmpeg that writes videos."""
    try:
        import imageio_ffmpeg

        return Finding("ffmpeg", f"{imageio_ffmpeg.get_ffmpeg_version()}, {imageio_ffmpeg.get_ffmpeg_exe()}")
    except Exception as error:
        text = f'none ({describe_error(error)}); videos cannot be written; run "pip install imageio-ffmpeg"'
        return Finding("ffmpeg", text, is_fallback=True)
