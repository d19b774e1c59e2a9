"""Raises `MissingPackage` when it is imported without the extra `commands`; the rooms that need this extra import it first."""

from __future__ import annotations

from snarfcli.extras import require_packages

__all__: list[str] = []

require_packages("commands")
