"""The module `snarfcli.avatar`, for tools that read code without running it."""

from snarfcli.avatar import *  # noqa: F403
