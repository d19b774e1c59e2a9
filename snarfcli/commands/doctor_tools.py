"""Lines of the report of `snarf doctor` about packages and programs: versions, whether they work, what stands in for them."""

from __future__ import annotations

import importlib
from collections.abc import Iterator

from snarfcli.commands.doctor_findings import Finding
from snarfcli.texts import one_line
from snarfcli.versions import installed_version

__all__ = ["EXTRAS", "TOOLS", "describe_error", "extras", "package_finding", "tools"]

TOOLS = {"embreex": "embreex.rtcore_scene", "libigl": "igl", "pymeshlab": "pymeshlab"}
"""Compiled packages that are imported to see whether they work, and the module that shows it."""
_INSTEAD = {
    "embreex": "libigl traces the rays, several times slower; there are no wheels for Linux on ARM",
    "pymeshlab": "snarf spreads the surface points (poisson=own) and libigl decimates; data=clothed needs it",
}
"""What is used where a package is missing."""
_LICENCES = {"pymeshlab": "licence GPL-3; can be left out: poisson=own, and libigl decimates"}

EXTRAS = {
    "view": ("viser", "snarf view"),
    "hub": ("huggingface-hub", "avatars of the Hugging Face Hub, Avatar.from_pretrained"),
    "blender": ("bpy", "snarf export format=fbx and usd; a blender on the PATH serves too"),
    "joblib": ("hydra-joblib-launcher", "several runs at a time, launcher=joblib"),
    "submitit": ("hydra-submitit-launcher", "runs on a cluster, launcher=submitit_slurm"),
}
"""Extras of single functions: the package that each brings, and what needs it."""


def tools() -> Iterator[Finding]:
    """Yield ffmpeg and the compiled packages."""
    yield _ffmpeg()
    for package, module in TOOLS.items():
        yield package_finding("embree" if package == "embreex" else package, package, module)


def extras() -> Iterator[Finding]:
    """Yield the extras of single functions. None is a fallback: what needs one says so when it is used."""
    for extra, (package, purpose) in EXTRAS.items():
        installed = installed_version(package)
        missing = f"not installed; for {purpose}: pip install 'snarf[{extra}]'"
        yield Finding(extra, missing if installed is None else f"{package} {installed}, for {purpose}")


def package_finding(name: str, package: str, module: str | None = None) -> Finding:
    """Return the version of a package and, if `module` is given, whether that module can be imported."""
    installed = installed_version(package)
    instead = f"; {_INSTEAD[package]}" if package in _INSTEAD else ""
    if installed is None:
        return Finding(name, f'not installed{instead}; run "pip install {package}"', is_fallback=True)
    try:
        if module is not None:
            importlib.import_module(module)
    except Exception as error:
        text = f"{package} {installed} cannot be imported: {describe_error(error)}{instead}"
        return Finding(name, text, is_fallback=True)
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
