"""The module `snarfcli.export.vrm`, for tools that read code without running it."""

from snarfcli.export.vrm import *  # noqa: F403
