"""What leaves the house: mesh files, pictures, videos, contact sheets."""

from snarfcli.export.camera import Camera
from snarfcli.export.meshes import read_mesh, weights_to_colors, write_mesh, write_obj, write_ply
from snarfcli.export.render import Look, render
from snarfcli.export.sheet import contact_sheet, write_png
from snarfcli.export.video import write_video

__all__ = [
    "Camera",
    "Look",
    "contact_sheet",
    "read_mesh",
    "render",
    "weights_to_colors",
    "write_mesh",
    "write_obj",
    "write_ply",
    "write_png",
    "write_video",
]
