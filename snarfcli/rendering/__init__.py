"""Pictures and videos of meshes, by ray casting on the CPU."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
from snarfcli.rendering.camera import Camera
from snarfcli.rendering.render import Look, render
from snarfcli.rendering.sheet import contact_sheet, write_png
from snarfcli.rendering.video import write_video

__all__ = ["Camera", "Look", "contact_sheet", "render", "write_png", "write_video"]
