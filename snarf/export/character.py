"""The module `snarfcli.export.character`, for tools that read code without running it."""

from snarfcli.export.character import *  # noqa: F403
