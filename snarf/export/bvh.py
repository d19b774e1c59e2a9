"""The module `snarfcli.export.bvh`, for tools that read code without running it."""

from snarfcli.export.bvh import *  # noqa: F403
