"""The optional parts of the installation, and the error for packages that are missing."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

from snarfcli.errors import UserError
from snarfcli.texts import one_line

__all__ = ["MissingPackage", "missing_packages", "require_packages", "why_not_imported"]

# The packages that are imported with the modules that use them, by the name of the module; others are imported when needed.
_PACKAGES = {
    "commands": {
        "filelock": "filelock",
        "hydra": "hydra-core",
        "igl": "libigl",
        "PIL": "pillow",
        "scipy": "scipy",
        "skimage": "scikit-image",
    },
    "hub": {"huggingface_hub": "huggingface-hub"},
}


class MissingPackage(UserError, ImportError):
    """A package that an optional part of the library needs is not installed; the message names the extra that brings it."""


def missing_packages(extra: str) -> list[str]:
    """Return the packages of an extra that are not installed. None of them is imported."""
    return [package for module, package in _PACKAGES[extra].items() if find_spec(module) is None]


def require_packages(extra: str) -> None:
    """Raise `MissingPackage` unless the packages of an extra, as in `pip install 'snarf[commands]'`, are installed."""
    missing = missing_packages(extra)
    if missing:
        raise MissingPackage(
            f"this part of snarf needs packages that are not installed ({', '.join(missing)}); "
            f"install them with: pip install 'snarf[{extra}]'"
        )


def why_not_imported(package: str, *modules: str) -> str | None:
    """Import the modules of a compiled package that something else can stand in for.

    Args:
        package: its name, which the reason starts with.
        modules: names of its modules; the first part of each is the package's module.

    Returns:
        Why that fails, as one line, or None if they are imported now. The package may be missing, or be there without a
        library of the system that it needs.
    """
    try:
        for module in modules:
            import_module(module)
    except (ImportError, OSError) as error:
        if isinstance(error, ModuleNotFoundError) and error.name in {modules[0].partition(".")[0], *modules}:
            return f"{package} is not installed"
        return f"{package} cannot be imported: {one_line(error, 200)}"
    return None
