"""Sample the motions of a glTF file as transforms of its joints."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from snarfcli.errors import UserError
from snarfcli.formats.gltf_file import GltfFile
from snarfcli.formats.gltf_motion import GltfAnimation, LeftOut
from snarfcli.formats.gltf_nodes import NodeTree
from snarfcli.formats.gltf_skin import check_transforms
from snarfcli.formats.rig import RigClip
from snarfcli.names import unique_names

__all__ = ["printable_names", "sample_clips"]

# Transforms of nodes in one clip, and of joints in all clips, 128 bytes each.
_MAX_NODE_FRAMES = 1_500_000
_MAX_JOINT_FRAMES = 2_000_000
_NODE_COST = 20  # frames; a node costs as much even if it does not move


def sample_clips(
    file: GltfFile, tree: NodeTree, animations: list[GltfAnimation], joints: list[int], names: tuple[str, ...]
) -> tuple[tuple[RigClip, ...], LeftOut]:
    """Return the world transforms of the joints in each animation, and the animations that cannot be used.

    Args:
        file: the file, for messages.
        tree: its nodes.
        animations: A sampled animations.
        joints: J node indices.
        names: J names, for messages.

    Raises:
        UserError: there are too many frames.
    """
    relevant, joint_frames = tree.with_ancestors(joints), 0
    clips: list[RigClip] = []
    left_out: LeftOut = []
    clip_names = printable_names((animation.name for animation in animations), "clip")
    for name, animation in zip(clip_names, animations, strict=True):
        joint_frames += (animation.num_frames + _NODE_COST) * len(joints)
        if (animation.num_frames + _NODE_COST) * len(relevant) > _MAX_NODE_FRAMES or joint_frames > _MAX_JOINT_FRAMES:
            file.fail(f"its animations have too many frames for {len(relevant)} nodes; export fewer, or cut them")
        worlds = tree.worlds(relevant, animation.nodes, keep_zero=False)
        poses = np.empty((animation.num_frames, len(joints), 4, 4))
        for column, joint in enumerate(joints):
            poses[:, column] = worlds[joint]
        try:
            check_transforms(file, poses, names, f" in clip {name}")
        except UserError as error:
            left_out.append((name, file.reason(error)))
            continue
        clips.append(RigClip(name, animation.frame_rate, poses))
    return tuple(clips), left_out


def printable_names(names: Iterable[Any], what: str) -> tuple[str, ...]:
    """Return the names as unique, printable text; items that are not text get the name `<what>_<index>`."""
    found = []
    for number, name in enumerate(names):
        name = "".join(letter if letter.isprintable() else "_" for letter in name[:100]) if isinstance(name, str) else ""
        found.append(name or f"{what}_{number}")
    return tuple(unique_names(found))
