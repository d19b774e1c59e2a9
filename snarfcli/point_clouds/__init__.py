"""Points on the surface of something: their normals, and the closed surface around them."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
from snarfcli.point_clouds.closing import close_surface
from snarfcli.point_clouds.normals import CheckedNormals, check_normals, estimate_normals

__all__ = ["CheckedNormals", "check_normals", "close_surface", "estimate_normals"]
