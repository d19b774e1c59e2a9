"""Files for other programs: rigged characters (GLB, FBX, USD) and sequences of meshes."""

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage
