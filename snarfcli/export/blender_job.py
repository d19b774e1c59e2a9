"""Script that runs in Blender: read a `.glb` file, write `.fbx` or `.usd`. It imports nothing of this package."""

from __future__ import annotations

import sys
from typing import Any

__all__ = ["main"]

_GAP = 10  # frames between clips


def main(glb: str, path: str, frame_rate: str, kind: str) -> None:
    """Convert one file to fbx or usd, with keys at whole frames of `frame_rate`."""
    import bpy  # pyright: ignore[reportMissingImports]  # only Blender has it

    rate = float(frame_rate)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = max(1, round(rate))
    scene.render.fps_base = rate / scene.render.fps  # 29.97 and the like: the importer multiplies by it
    scene.frame_start = 0
    bpy.ops.import_scene.gltf(filepath=glb, disable_bone_shape=True)
    scene.render.fps_base = scene.render.fps / rate  # everything else divides by it
    for item in [item for item in bpy.data.objects if item.type == "EMPTY"]:
        bpy.data.objects.remove(item)  # made of the node of a skinned mesh, with the name of the mesh
    meshes = [item for item in bpy.data.objects if item.type == "MESH"]
    for item in meshes:
        item.name = item.data.name
    moving = [item for item in bpy.data.objects if item.type == "ARMATURE"]
    moving += [item.data.shape_keys for item in meshes if item.data.shape_keys]
    scene.frame_end = _lay_out([item.animation_data for item in moving if item.animation_data])
    if kind == "fbx":
        bpy.ops.export_scene.fbx(
            filepath=path,
            object_types={"ARMATURE", "MESH"},
            add_leaf_bones=False,
            bake_anim_use_all_actions=False,
            bake_anim_use_nla_strips=True,  # one take per strip of the armature
            bake_anim_simplify_factor=0.0,
            use_mesh_modifiers=False,  # otherwise there are no shape keys
        )
    else:
        bpy.ops.wm.usd_export(filepath=path, export_animation=True, export_armatures=True, export_shapekeys=True)
    print("snarf: written", flush=True)


def _lay_out(animated: list[Any]) -> int:
    """Place the clips of the armature and of its shapes one after the other on the timeline; return the last frame.

    FBX takes are cut by the strips of the armature, but keep all strips of the shapes: these must not play at the same time.
    """
    lengths: dict[str, float] = {}
    for data in animated:
        for track in data.nla_tracks:
            length = max(strip.action.frame_range[1] for strip in track.strips)
            lengths[track.name] = max(length, lengths.get(track.name, 0))
    starts, end = {}, 0
    for name, length in lengths.items():
        starts[name], end = end, end + round(length) + _GAP
    for data in animated:
        data.action = None
        for track in data.nla_tracks:
            track.mute = False
            for strip in track.strips:
                strip.frame_start_ui = starts[track.name]
                strip.extrapolation = "HOLD" if len(lengths) == 1 else "NOTHING"
    return max(0, end - _GAP)


if __name__ == "__main__":
    main(*sys.argv[sys.argv.index("--") + 1 :])
