"""Export an avatar as VRM 1.0: a glTF file of a human in T-pose, with named bones and conditions of use.

Source: VRM Consortium, VRMC_vrm 1.0 (humanoid, meta, expressions, VRM T-pose).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.errors import UserError
from snarfcli.export.character import Character, CharacterOptions, check_options
from snarfcli.export.character_build import build_character
from snarfcli.export.character_glb import CharacterNodes, character_glb
from snarfcli.export.character_surface import character_surface
from snarfcli.export.clips import Clip
from snarfcli.export.export import ExportReport, check_output, report_of
from snarfcli.export.human_bones import human_bones
from snarfcli.export.t_pose import t_pose_stance
from snarfcli.export.vrm_meta import VrmMeta, meta_object
from snarfcli.export.vrma import export_vrma
from snarfcli.models.trained_field import TrainedField

__all__ = ["export_vrm"]


def export_vrm(
    avatar: TrainedField,
    path: str | Path,
    clips: Sequence[Clip],
    options: CharacterOptions,
    meta: VrmMeta | None = None,
    *,
    name: str | None = None,
    joint_names: Sequence[str] | None = None,
    clip_files: Sequence[Path] | None = None,
    overwrite: bool = False,
) -> ExportReport:
    """Write an avatar as `.vrm`, whole or not at all: mesh, skeleton in T-pose, humanoid bones, and shapes as expressions.

    The format has no clips: `clips` show how the shape depends on the pose, and are what the report measures; `clip_files` has
    them as `.vrma`, with the weights of the expressions. The soles stand on y = 0, the body faces +z.

    Args:
        avatar: an avatar with skinning weights and a human skeleton.
        path: the file.
        clips: motions, at least one.
        options: limits on the size of the character.
        meta: model information and conditions of use; cautious ones by default.
        name: name of the mesh, and of the model if `meta` has none; by default the subject of the avatar.
        joint_names: names of the joints' nodes; by default those of the avatar's skeleton.
        clip_files: one `.vrma` file per clip; None writes none.
        overwrite: whether existing files are replaced.

    Raises:
        UserError: the skeleton is not human, an option is out of range, the file exists, or the avatar has no weights or no
            surface.
    """
    check_options(options)
    path = Path(path)
    for file in (path, *(clip_files or ())):
        check_output(file, overwrite)
    if not clips:
        raise UserError("clips: wanted at least one motion that shows the shape, got none; give a motion")
    skeleton = avatar.skeleton
    bones = human_bones(skeleton)
    stance = t_pose_stance(skeleton, bones)
    character = _on_ground(build_character(avatar, character_surface(avatar, options), clips, options, stance))
    report = report_of(path, character, options)
    name = name or str(avatar.facts.get("subject", "avatar"))
    builder, nodes = character_glb(
        replace(character, clips=[]),
        joint_names or skeleton.names,
        skeleton.parents,
        name=name,
        weight_colors=options.weight_colors,
        facts={"snarf": report.facts()},
    )
    builder.root["extensionsUsed"] = ["VRMC_vrm"]
    builder.root["extensions"] = {"VRMC_vrm": _extension(character, bones, nodes, meta or VrmMeta(), name)}
    size = builder.write(path)
    if clip_files is not None:
        height = float(character.bind[bones["hips"], 1, 3])
        for file, clip, written in zip(clip_files, clips, character.clips, strict=True):
            shapes = written.shape_weights
            export_vrma(file, clip, skeleton, hips_height=height, shape_weights=shapes, overwrite=overwrite)
    return report_of(path, character, options, size)


def _on_ground(character: Character) -> Character:
    """Return a character moved vertically so that its lowest vertex is at y = 0."""
    up = np.array([0, -character.mesh.vertices[:, 1].min(), 0])
    mesh = replace(character.mesh, vertices=(character.mesh.vertices + up).astype(np.float32))
    bind = character.bind.copy()
    bind[:, :3, 3] += up
    return replace(character, mesh=mesh, bind=bind)


def _extension(character: Character, bones: dict[str, int], nodes: CharacterNodes, meta: VrmMeta, name: str) -> dict[str, Any]:
    """Return the extension VRMC_vrm."""
    # The names are those of the morph targets, and of the tracks in .vrma files.
    custom = {
        f"shape_{number}": {"morphTargetBinds": [{"node": nodes.mesh, "index": number, "weight": 1.0}]}
        for number in range(len(character.shapes.targets))
    }
    return {
        "specVersion": "1.0",
        "meta": meta_object(meta, name),
        "humanoid": {"humanBones": {bone: {"node": nodes.first_joint + joint} for bone, joint in bones.items()}},
        "firstPerson": {"meshAnnotations": [{"node": nodes.mesh, "type": "auto"}]},
        **({"expressions": {"custom": custom}} if custom else {}),
    }
