"""Export a motion as VRM animation (.vrma), which plays on any VRM model.

Source: VRM Consortium, VRMC_vrm_animation 1.0.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.bodies import Skeleton
from snarfcli.export.clips import Clip, clip_transforms
from snarfcli.export.export import check_output
from snarfcli.export.glb import GlbBuilder
from snarfcli.export.human_bones import human_bones
from snarfcli.export.rig import bind_frames, decompose, local_frames
from snarfcli.export.t_pose import t_pose_stance

__all__ = ["export_vrma"]

_NOT_ANIMATED = ("leftEye", "rightEye")  # VRM turns the eyes by a point that they look at


def export_vrma(
    path: str | Path,
    clip: Clip,
    skeleton: Skeleton,
    *,
    hips_height: float | None = None,
    shape_weights: NDArray | None = None,
    overwrite: bool = False,
) -> int:
    """Write a motion as `.vrma`, whole or not at all: rotations of the humanoid bones, the way of the hips, and expressions.

    The nodes rest in the T-pose, with the axes of the avatar's joints there, so that `read_motion` gives back the poses. Joints
    between two bones are part of the motion of the lower bone. Changes of length are left out, as the format requires.

    Args:
        path: the file.
        clip: a motion of the skeleton.
        skeleton: a human skeleton.
        hips_height: height of the hips above the soles in the T-pose, metres, by which programs scale the motion to a model; by
            default that above the lowest joint.
        shape_weights: [T, K] weights from 0 to 1 of the custom expressions shape_0 and so on; None for none.
        overwrite: whether an existing file is replaced.

    Returns:
        Size of the file in bytes.

    Raises:
        UserError: the skeleton is not human, or the file exists.
    """
    path = Path(path)
    check_output(path, overwrite)
    bones = {bone: joint for bone, joint in human_bones(skeleton).items() if bone not in _NOT_ANIMATED}
    bones = dict(sorted(bones.items(), key=lambda item: item[1]))  # parents first
    joints = list(bones.values())
    parents = _nearest_above(joints, skeleton.parents)
    stance = t_pose_stance(skeleton, bones)
    frames = stance.from_canonical @ bind_frames(skeleton)
    worlds = clip_transforms(skeleton, clip) @ bind_frames(skeleton)
    standing = frames.copy()
    lowest = standing[:, 1, 3].min() if hips_height is None else standing[bones["hips"], 1, 3] - hips_height
    standing[:, 1, 3] -= lowest
    rest = decompose(local_frames(standing[None][:, joints], parents))
    local = decompose(local_frames(worlds[:, joints], parents))
    builder = GlbBuilder()
    for number, bone in enumerate(bones):
        children = [child for child, parent in enumerate(parents) if parent == number]
        place, turn = _numbers(rest.translation[0, number]), _numbers(rest.rotation[0, number])
        builder.add("nodes", name=bone, translation=place, rotation=turn, children=children or None)
    tracks = [(number, "rotation", local.rotation[:, number]) for number in range(len(bones))]
    hips = list(bones).index("hips")
    tracks.append((hips, "translation", local.translation[:, hips]))
    extension: dict[str, Any] = {
        "specVersion": "1.0",
        "humanoid": {"humanBones": {bone: {"node": number} for number, bone in enumerate(bones)}},
    }
    roots = [number for number, parent in enumerate(parents) if parent < 0]
    if shape_weights is not None and shape_weights.shape[1]:
        custom = {}
        for number, weights in enumerate(shape_weights.T):  # the weight is the x coordinate of a node
            node = builder.add("nodes", name=f"shape_{number}")
            tracks.append((node, "translation", np.pad(weights[:, None], ((0, 0), (0, 2)))))
            custom[f"shape_{number}"] = {"node": node}
            roots.append(node)
        extension["expressions"] = {"custom": custom}
    builder.add("scenes", nodes=roots)
    builder.root["scene"] = 0
    _add_animation(builder, clip, tracks)
    builder.root["extensionsUsed"] = ["VRMC_vrm_animation"]
    builder.root["extensions"] = {"VRMC_vrm_animation": extension}
    return builder.write(path)


def _add_animation(builder: GlbBuilder, clip: Clip, tracks: list[tuple[int, str, NDArray[np.float64]]]) -> None:
    """Add the animation with its tracks: node, path and values of all frames."""
    count = clip.motion.num_frames
    times = builder.array(np.arange(count) / clip.motion.frame_rate, bounds=True)
    samplers = [{"input": times, "output": builder.array(values), "interpolation": "LINEAR"} for _, _, values in tracks]
    channels = [{"sampler": at, "target": {"node": node, "path": kind}} for at, (node, kind, _) in enumerate(tracks)]
    extras = {"frame_rate": clip.motion.frame_rate, "frames": count}
    builder.add("animations", name=clip.motion.name or "clip", channels=channels, samplers=samplers, extras=extras)


def _nearest_above(joints: list[int], parents: tuple[int, ...]) -> list[int]:
    """Return for each joint the place in `joints` of its nearest ancestor there, -1 if there is none."""
    place = {joint: number for number, joint in enumerate(joints)}
    found = []
    for joint in joints:
        above = parents[joint]
        while above >= 0 and above not in place:
            above = parents[above]
        found.append(place.get(above, -1))
    return found


def _numbers(values: NDArray[np.float64]) -> list[float]:
    """Return numbers for JSON, rounded to float32, without negative zeros."""
    return [float(value) + 0.0 for value in values.astype(np.float32)]
