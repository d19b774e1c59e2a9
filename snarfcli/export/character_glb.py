"""A character as one `.glb` file: mesh, morph targets, skin, nodes and animations.

Source: Khronos, glTF 2.0 specification, 3.7 (meshes, morph targets, skins) and 3.11 (animations).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.export.character import Character, CharacterClip
from snarfcli.export.compact import QUANTIZATION, StoredCube, shares, signed_bytes, signed_shares
from snarfcli.export.glb import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, GlbBuilder
from snarfcli.export.rig import decompose, local_frames
from snarfcli.meshing.colors import from_srgb, weights_to_colors
from snarfcli.meshing.mesh import vertex_normals

__all__ = ["CharacterNodes", "character_glb", "write_character"]

# Linear RGBA, as in glTF. Clay is light enough to show shading; it multiplies the colours of weights, so these need white.
_CLAY = (0.62, 0.50, 0.42, 1.0)
_WHITE = (1.0, 1.0, 1.0, 1.0)
_ROUGHNESS = 0.75
_MOVES = {"translation": 1e-6, "rotation": 1e-7, "scale": 1e-6}
"""Paths of the channels of a node, and the largest difference from the value of the node that is rounding (metres, 1, 1)."""


@dataclass(frozen=True)
class CharacterNodes:
    """Indices of the nodes of a character."""

    mesh: int
    """The skinned mesh."""
    first_joint: int
    """Joint 0; the others follow in order."""


def write_character(
    path: str | Path, character: Character, joint_names: Sequence[str], parents: Sequence[int], **more: Any
) -> int:
    """Write a character, whole or not at all, and return the size of the file in bytes; see `character_glb`."""
    return character_glb(character, joint_names, parents, **more)[0].write(path)


def character_glb(
    character: Character,
    joint_names: Sequence[str],
    parents: Sequence[int],
    *,
    name: str = "avatar",
    weight_colors: bool = False,
    compact: bool = False,
    facts: dict[str, Any] | None = None,
) -> tuple[GlbBuilder, CharacterNodes]:
    """Return the content of a file with a character.

    Nodes: the skinned mesh, a parent of all joints, and the joints in the stored pose. y is up, the root joint has the
    translation of the motion, units are metres. `extras.targetNames` of the mesh names the morph targets.

    Args:
        character: mesh, rig, clips and shapes.
        joint_names: names of the J joints.
        parents: parents of the J joints, -1 for a root.
        name: name of the mesh; the parent of all joints is called `name_rig`.
        weight_colors: whether vertices are coloured by their weights.
        compact: whether vertices, weights and rotations are stored as numbers of 8 and 16 bits, in about half of the bytes
            (the extension KHR_mesh_quantization), which three.js reads and few other programs do.
        facts: content of `asset.extras`.

    Returns:
        The file, to which more can be added before it is written, and its nodes.
    """
    builder = GlbBuilder(**(facts or {}))
    cube = StoredCube.around(character) if compact else None
    if compact:
        builder.root |= {"extensionsUsed": [QUANTIZATION], "extensionsRequired": [QUANTIZATION]}
    roots = [2 + joint for joint, parent in enumerate(parents) if parent < 0]
    mesh_node = builder.add("nodes", name=name, mesh=_add_mesh(builder, character, name, weight_colors, cube), skin=0)
    armature = builder.add("nodes", name=f"{name}_rig", children=roots)
    first = len(builder.root["nodes"])
    rest = decompose(local_frames(character.bind[None], parents))
    for joint, joint_name in enumerate(joint_names):
        children = [first + other for other, parent in enumerate(parents) if parent == joint]
        scale = rest.scale[0, joint]
        builder.add(
            "nodes",
            name=joint_name,
            translation=_numbers(rest.translation[0, joint]),
            rotation=_numbers(rest.rotation[0, joint]),
            scale=_numbers(scale) if np.any(scale != 1) else None,
            children=children or None,
        )
    builder.add("scenes", name=name, nodes=[mesh_node, armature])
    builder.root["scene"] = 0
    joints_from_metres = np.linalg.inv(character.bind)
    builder.add(
        "skins",
        name=name,
        joints=list(range(first, first + len(parents))),
        inverseBindMatrices=builder.array(joints_from_metres if cube is None else joints_from_metres @ cube.metres_from_stored),
        skeleton=armature,
    )
    moving = {path: _moving(character.clips, path, getattr(rest, path)[0]) for path in _MOVES}
    # A clip needs at least one channel, which also gives its length.
    moving["translation"][roots[0] - first] = moving["rotation"][roots[0] - first] = True
    for clip in character.clips:
        _add_clip(builder, clip, moving, first, mesh_node if len(character.shapes.targets) else None, compact)
    return builder, CharacterNodes(mesh_node, first)


def _add_mesh(builder: GlbBuilder, character: Character, name: str, weight_colors: bool, cube: StoredCube | None) -> int:
    """Add the mesh with its attributes, morph targets and material; return its index."""
    mesh = character.mesh
    assert mesh.normals is not None
    assert mesh.weights is not None

    def places(values: NDArray, *, are_moves: bool = False) -> int:
        if cube is None:
            return builder.array(values, target=ARRAY_BUFFER, bounds=True)
        stored = cube.moves(values) if are_moves else cube.places(values)
        return builder.array(stored, "int16", target=ARRAY_BUFFER, bounds=True, normalized=True)

    def normals(values: NDArray) -> int:
        if cube is None:
            return builder.array(values, target=ARRAY_BUFFER)
        return builder.array(signed_bytes(values), "int8", target=ARRAY_BUFFER, normalized=True)

    attributes = {"POSITION": places(mesh.vertices), "NORMAL": normals(_units(mesh.normals))}
    if weight_colors:
        colors = _linear(weights_to_colors(mesh.weights))
        attributes["COLOR_0"] = builder.array(colors, "uint16", target=ARRAY_BUFFER, normalized=True)
    joint_type = "uint8" if len(character.bind) <= 256 else "uint16"
    weights = character.weights if cube is None else shares(character.weights)
    weight_type, options = ("float32", {}) if cube is None else ("uint16", {"normalized": True})
    joints = np.where(weights > 0, character.joints, 0)  # as the format asks for; small weights are rounded to 0
    for number, start in enumerate(range(0, joints.shape[1], 4)):
        part = slice(start, start + 4)
        attributes[f"JOINTS_{number}"] = builder.array(joints[:, part], joint_type, target=ARRAY_BUFFER)
        attributes[f"WEIGHTS_{number}"] = builder.array(weights[:, part], weight_type, target=ARRAY_BUFFER, **options)
    targets = []
    for moved in character.shapes.targets:
        bent = vertex_normals(mesh.vertices + moved, mesh.faces) - mesh.normals
        targets.append({"POSITION": places(moved, are_moves=True), "NORMAL": normals(bent)})
    index_type = "uint16" if len(mesh.vertices) < 2**16 else "uint32"  # 65535 is reserved
    material = builder.add(
        "materials",
        name="weights" if weight_colors else "clay",
        pbrMetallicRoughness={
            "baseColorFactor": list(_WHITE if weight_colors else _CLAY),
            "metallicFactor": 0.0,
            "roughnessFactor": _ROUGHNESS,
        },
    )
    primitive = {
        "attributes": attributes,
        "indices": builder.array(mesh.faces.ravel(), index_type, target=ELEMENT_ARRAY_BUFFER),
        "material": material,
        **({"targets": targets} if targets else {}),
    }
    return builder.add(
        "meshes",
        name=name,
        primitives=[primitive],
        weights=_numbers(character.shapes.rest) or None,
        extras={"targetNames": [f"shape_{number}" for number in range(len(targets))]} if targets else None,
    )


def _add_clip(
    builder: GlbBuilder,
    clip: CharacterClip,
    moving: dict[str, NDArray[np.bool_]],
    first: int,
    mesh_node: int | None,
    compact: bool,
) -> None:
    """Add an animation; constant channels keep their first and last key only."""
    count = len(clip.joints.rotation)
    times = np.arange(count) / clip.frame_rate
    time_arrays: dict[int, int] = {}
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def add(node: int, path: str, values: NDArray) -> None:
        values = np.asarray(values, dtype=np.float32)
        keys = slice(None)
        if count > 2 and (values == values[0]).all():
            keys = slice(None, None, count - 1)
        number = len(times[keys])
        if number not in time_arrays:
            time_arrays[number] = builder.array(times[keys], bounds=True)
        flat = values[keys].reshape(-1) if path == "weights" else values[keys]
        if compact and path in ("rotation", "weights"):
            output = builder.array(signed_shares(flat), "int16", normalized=True)
        else:
            output = builder.array(flat)
        samplers.append({"input": time_arrays[number], "output": output, "interpolation": "LINEAR"})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})

    for path, which in moving.items():
        for joint in np.flatnonzero(which):
            add(first + int(joint), path, getattr(clip.joints, path)[:, joint])
    if mesh_node is not None:
        add(mesh_node, "weights", clip.shape_weights)
    extras = {"frame_rate": clip.frame_rate, "frames": count}
    builder.add("animations", name=clip.name, channels=channels, samplers=samplers, extras=extras)


def _moving(clips: Sequence[CharacterClip], path: str, rest: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which joints [J] differ from the values of their nodes in any clip: these need a channel in every clip.

    Otherwise a program that changes from one clip to the next would keep the values of the first.
    """
    away = np.zeros(len(rest), dtype=bool)
    for clip in clips:
        values = getattr(clip.joints, path)
        difference = np.abs(values - rest)
        if path == "rotation":  # the other sign is the same rotation
            difference = np.minimum(difference.max(-1), np.abs(values + rest).max(-1))[..., None]
        away |= (difference > _MOVES[path]).any(axis=(0, 2))
    return away


def _linear(colors: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return sRGB colours [V, 3] as linear RGBA [V, 4] from 0 to 65535 (glTF 2.0, 3.7.2.1: linear)."""
    return np.rint(65535 * np.hstack([from_srgb(colors), np.ones((len(colors), 1))]))


def _units(normals: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return normals [V, 3] of length 1 to the precision of float32."""
    return normals / np.linalg.norm(normals.astype(np.float64), axis=1, keepdims=True)


def _numbers(values: NDArray) -> list[float]:
    """Return numbers for JSON, rounded to float32, without negative zeros."""
    return [float(value) + 0.0 for value in values.astype(np.float32)]
