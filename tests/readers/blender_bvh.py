"""Runs inside of Blender: prints where the joints of a BVH file are at some frames, metres, y up as in the file.

Arguments after "--": FILE RATE FRAME...
"""

import json
import sys

import bpy

path, rate, *frames = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = round(float(rate))
bpy.ops.import_anim.bvh(filepath=path, global_scale=0.01, frame_start=1, rotate_mode="NATIVE")
armature = next(item for item in bpy.data.objects if item.type == "ARMATURE")
found = []
for frame in frames:
    bpy.context.scene.frame_set(1 + int(frame))  # its first frame is 1
    heads = {bone.name: armature.matrix_world @ bone.head for bone in armature.pose.bones}
    found.append({name: [head.x, head.z, -head.y] for name, head in heads.items()})
print("\nBLENDER " + json.dumps({"frames": found}), flush=True)
