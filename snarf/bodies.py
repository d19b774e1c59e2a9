"""The module `snarfcli.bodies`, for tools that read code without running it."""

from snarfcli.bodies import *  # noqa: F403
