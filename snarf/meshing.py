"""The module `snarfcli.meshing`, for tools that read code without running it."""

from snarfcli.meshing import *  # noqa: F403
