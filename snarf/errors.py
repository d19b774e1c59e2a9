"""The module `snarfcli.errors`, for tools that read code without running it."""

from snarfcli.errors import *  # noqa: F403
