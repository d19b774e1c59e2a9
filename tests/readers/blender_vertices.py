"""Runs inside of Blender: prints what it makes of a file, with all vertices in the world at some frames.

Arguments after "--": FILE RATE CLIP FRAME...  Blender's z is up; the vertices are printed with y up, as in the file.
"""

import json
import sys

import bpy

path, rate, clip, *frames = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
render = bpy.context.scene.render
render.fps = round(float(rate))
render.fps_base = render.fps / float(rate)
if path.endswith(".fbx"):
    bpy.ops.import_scene.fbx(filepath=path, anim_offset=0.0)
elif path.endswith(".glb"):
    render.fps_base = float(rate) / render.fps  # this importer multiplies by it, all others divide
    bpy.ops.import_scene.gltf(filepath=path, disable_bone_shape=True)
else:
    bpy.ops.wm.usd_import(filepath=path)
mesh = max((item for item in bpy.data.objects if item.type == "MESH"), key=lambda item: len(item.data.vertices))
armature = next(item for item in bpy.data.objects if item.type == "ARMATURE")
moving = [item for item in (armature, mesh.data.shape_keys) if item and item.animation_data]
for item in moving:  # a clip of a glTF file is a track of the NLA editor, one of an FBX file is an action OBJECT|CLIP
    data = item.animation_data
    for action in bpy.data.actions:
        owner, _, name = action.name.rpartition("|")
        if owner == item.name and name == clip:
            data.action = action
            data.action_slot = action.slots[0]
    for track in data.nla_tracks:
        if track.name == clip:
            data.action = track.strips[0].action
            data.action_slot = track.strips[0].action_slot
        track.mute = True
found = []
for frame in frames:
    bpy.context.scene.frame_set(int(frame))
    posed = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get())
    world = [posed.matrix_world @ vertex.co for vertex in posed.data.vertices]
    found.append([[v.x, v.z, -v.y] for v in world])
facts = {
    "version": bpy.app.version_string,
    "bones": [bone.name for bone in armature.data.bones],
    "clips": {action.name: list(action.frame_range) for action in bpy.data.actions},
    "shape_keys": [key.name for key in mesh.data.shape_keys.key_blocks[1:]] if mesh.data.shape_keys else [],
    "smooth": all(face.use_smooth for face in mesh.data.polygons),
    "frames": found,
}
print("\nBLENDER " + json.dumps(facts), flush=True)
