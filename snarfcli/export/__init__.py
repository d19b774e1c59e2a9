"""Files for other programs: rigged characters (GLB, FBX, USD) and sequences of meshes."""
