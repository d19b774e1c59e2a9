"""The module `snarfcli.networks`, for tools that read code without running it."""

from snarfcli.networks import *  # noqa: F403
