"""Points on the surface of something: their files, their normals, and the closed surface around them."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
from snarfcli.point_clouds.bone_sides import bone_normals
from snarfcli.point_clouds.closing import close_surface
from snarfcli.point_clouds.files import PointFile, list_frames, read_frame, read_points
from snarfcli.point_clouds.neighbours import LEAST_POINTS, point_areas
from snarfcli.point_clouds.normals import CheckedNormals, check_normals, estimate_normals

__all__ = [
    "LEAST_POINTS",
    "CheckedNormals",
    "PointFile",
    "bone_normals",
    "check_normals",
    "close_surface",
    "estimate_normals",
    "list_frames",
    "point_areas",
    "read_frame",
    "read_points",
]
