"""The module `snarfcli.motions`, for tools that read code without running it."""

from snarfcli.motions import *  # noqa: F403
