"""The optional parts of the installation, and the error for packages that are missing."""

from __future__ import annotations

from importlib.util import find_spec

from snarfcli.errors import UserError

__all__ = ["MissingPackage", "require_packages"]


class MissingPackage(UserError, ImportError):
    """A package that an optional part of the library needs is not installed; the message names the extra that brings it."""


def require_packages(extra: str, packages: dict[str, str]) -> None:
    """Raise `MissingPackage` unless all packages of an extra are installed. None of them is imported.

    Args:
        extra: name of the extra, as in `pip install 'snarf[commands]'`.
        packages: names of packages by the module that each is imported as.
    """
    missing = [package for module, package in packages.items() if find_spec(module) is None]
    if missing:
        raise MissingPackage(
            f"this part of snarf needs packages that are not installed ({', '.join(missing)}); "
            f"install them with: pip install 'snarf[{extra}]'"
        )
