"""Read which nodes of a VRM file are which bones of a human body.

VRM characters (`.vrm`) and animations (`.vrma`) are glTF files with such a table, so the names of their nodes do not matter.

Source: VRM Consortium, VRMC_vrm 1.0 and VRMC_vrm_animation 1.0 (humanoid), VRM 0.0 (humanoid).
"""

from __future__ import annotations

import itertools
from typing import Any

from snarfcli.formats.gltf_file import GltfFile

__all__ = ["read_humanoid"]

_MAX_NAME = 40  # letters
_MAX_BONES = 200  # a humanoid has 55


def read_humanoid(file: GltfFile) -> dict[str, int]:
    """Return the node of each bone by its name in VRM 1.0, such as `leftUpperLeg`; empty for other files.

    Entries that name no node, as old exporters write them for missing bones, are left out; so are second bones of one node.
    """
    found: dict[str, int] = {}
    for extension in ("VRMC_vrm", "VRMC_vrm_animation", "VRM"):
        humanoid = file.extension(extension).get("humanoid")
        for bone, node in _entries(humanoid.get("humanBones") if isinstance(humanoid, dict) else None):
            is_node = type(node) is int and 0 <= node < len(file.items("nodes"))
            if isinstance(bone, str) and 0 < len(bone) <= _MAX_NAME and is_node and node not in found.values():
                found.setdefault(bone, node)
        if found:
            return _with_new_thumbs(found) if extension == "VRM" else found
    return {}


def _entries(bones: Any) -> list[tuple[Any, Any]]:
    """Return names and nodes from the object of VRM 1.0, or from the list of VRM 0."""
    if isinstance(bones, dict):
        return [
            (bone, entry.get("node")) for bone, entry in itertools.islice(bones.items(), _MAX_BONES) if isinstance(entry, dict)
        ]
    if isinstance(bones, list):
        return [(entry.get("bone"), entry.get("node")) for entry in bones[:_MAX_BONES] if isinstance(entry, dict)]
    return []


def _with_new_thumbs(bones: dict[str, int]) -> dict[str, int]:
    """Return the bones of VRM 0 by their names in VRM 1.0, which moved the names of the thumb towards the wrist."""
    renamed = {
        f"{side}Thumb{old}": f"{side}Thumb{new}"
        for side in ("left", "right")
        for old, new in (("Proximal", "Metacarpal"), ("Intermediate", "Proximal"))
    }
    return {renamed.get(bone, bone): node for bone, node in bones.items()}
