"""The module `snarfcli.shape`, for tools that read code without running it."""

from snarfcli.shape import *  # noqa: F403
