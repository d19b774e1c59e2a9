"""The module `snarfcli.export.clips`, for tools that read code without running it."""

from snarfcli.export.clips import *  # noqa: F403
