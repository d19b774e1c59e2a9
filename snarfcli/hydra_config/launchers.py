"""Hydra's launchers, which run the jobs of a multirun: which ones are installed, and what the others need."""

from __future__ import annotations

import importlib.util

__all__ = ["PLUGIN_LAUNCHERS", "is_installed", "missing_plugin"]

PLUGIN_LAUNCHERS = {"joblib": "joblib", "submitit_local": "submitit", "submitit_slurm": "submitit"}
"""Launchers that optional packages bring: name of each, and of the extra that installs its package."""


def missing_plugin(launcher: str, setting: str) -> str | None:
    """Return what to install for a launcher, as one line; None if it is installed, needs no package or is unknown.

    Args:
        launcher: its name.
        setting: the setting that names it.
    """
    package = PLUGIN_LAUNCHERS.get(launcher)
    if package is None or is_installed(package):
        return None
    return (
        f"{setting}={launcher} needs hydra-{package}-launcher; install it with: pip install 'snarf[{package}]' "
        f"(or pip install hydra-{package}-launcher)"
    )


def is_installed(package: str) -> bool:
    """Return whether Hydra's launcher joblib or submitit is installed."""
    try:
        return importlib.util.find_spec(f"hydra_plugins.hydra_{package}_launcher") is not None
    except ModuleNotFoundError:  # no Hydra plugin is installed
        return False
