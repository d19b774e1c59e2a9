"""What runs inside of Blender: read a `.glb`, write `.fbx` or `.usd`. Uses nothing of this package, which Blender may lack."""

from __future__ import annotations

import sys

__all__ = ["main"]


def main(glb: str, path: str, frame_rate: str) -> None:
    """Convert one file; keys fall on whole frames of `frame_rate`."""
    import bpy

    rate = float(frame_rate)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    render = bpy.context.scene.render
    render.fps = max(1, round(rate))
    render.fps_base = render.fps / rate  # 29.97 and the like
    bpy.ops.import_scene.gltf(filepath=glb, disable_bone_shape=True)
    ends = [action.frame_range[1] for action in bpy.data.actions]
    bpy.context.scene.frame_start = 0
    bpy.context.scene.frame_end = round(max(ends, default=0))
    if path.endswith(".fbx"):
        bpy.ops.export_scene.fbx(
            filepath=path,
            object_types={"ARMATURE", "MESH"},
            add_leaf_bones=False,
            bake_anim_use_all_actions=False,
            bake_anim_use_nla_strips=True,
            bake_anim_simplify_factor=0.0,
            use_mesh_modifiers=False,  # else no shape keys
        )
    else:
        bpy.ops.wm.usd_export(filepath=path, export_animation=True, export_armatures=True, export_shapekeys=True)
    print("snarf: written", flush=True)


if __name__ == "__main__":
    main(*sys.argv[sys.argv.index("--") + 1 :])
