"""What fits into a page of limited size: the number of triangles, and the frames of the clips.

The sizes are those of `character_glb(compact=True)` before compression.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from snarfcli.errors import UserError
from snarfcli.export.character import TRIANGLES, CharacterOptions
from snarfcli.export.clips import Clip

__all__ = ["MOST_BYTES", "PagePlan", "plan_page"]

MOST_BYTES = 5_000_000
"""Limit of the size of a page."""

_MESH_SHARE = 0.4  # of the bytes, at least, for the mesh: 20,000 triangles with 8 morph targets take about this much
_LEAST_RATE = 8.0  # frames per second of which a motion still looks like itself
_BASE_BYTES = 32  # of a vertex: place 8, normal 4, colour 8; joints 4 and weights 8 for four influences
_TARGET_BYTES = 12  # of a vertex in a morph target: place 8, normal 4
_INDEX_BYTES = 12  # of a triangle
_JSON_BYTES = 400  # of the description of a node, or of a channel of a clip; measured: 310


@dataclass(frozen=True)
class PagePlan:
    """A character that fits into a page."""

    options: CharacterOptions
    """With a number of triangles that fits."""
    clips: list[Clip]
    """With the frames that fit."""
    frame_rate: float | None
    """Frames per second of the first clip if frames were left out; otherwise None."""


def plan_page(clips: Sequence[Clip], options: CharacterOptions, joints: int, room: int) -> PagePlan:
    """Return what fits into a page.

    Args:
        clips: motions.
        options: wanted limits of the character.
        joints: number of joints.
        room: bytes for the character before compression.

    Raises:
        UserError: the motions are too long, or there are too many morph targets.
    """
    fixed = _JSON_BYTES * joints * (1 + sum(_channels(clip) for clip in clips))
    for_clips = (1 - _MESH_SHARE) * room - fixed
    needed = [clip.motion.num_frames * _frame_bytes(clip, options, joints) for clip in clips]
    step = 1
    while sum(needed) / step > for_clips and min(clip.motion.frame_rate for clip in clips) / (step + 1) >= _LEAST_RATE:
        step += 1
    if sum(needed) / step > for_clips:
        seconds = sum(clip.motion.num_frames / clip.motion.frame_rate for clip in clips)
        raise UserError(
            f"format=html: wanted motions that fit into {MOST_BYTES / 1e6:g} MB, got {seconds:.0f} s for {joints} joints; "
            "give fewer, or parts of them by start= and stop="
        )
    thinned = [_every(clip, step) for clip in clips]
    left = room - fixed - sum(clip.motion.num_frames * _frame_bytes(clip, options, joints) for clip in thinned)
    vertex = _BASE_BYTES * options.influences // 4 + _TARGET_BYTES * options.morph_targets
    most = int(left / (vertex / 2 + _INDEX_BYTES)) - 100  # a closed surface has half as many vertices as triangles
    if most < TRIANGLES[0]:
        raise UserError(
            f"format=html: morph_targets: wanted fewer, got {options.morph_targets}, which leave no room for a mesh"
        )
    triangles = most if options.triangles is None else min(options.triangles, most)
    return PagePlan(replace(options, triangles=triangles), thinned, thinned[0].motion.frame_rate if step > 1 else None)


def _channels(clip: Clip) -> int:
    """Return the number of channels of a joint: rotation, and place and scale of joints that stretch."""
    return 1 if clip.bone_transforms is None else 3


def _frame_bytes(clip: Clip, options: CharacterOptions, joints: int) -> int:
    """Return the size of a frame: its time, rotations, a place of the root (of all joints that stretch), and shapes."""
    places = 24 * joints if clip.bone_transforms is not None else 12
    return 4 + 8 * joints + places + 2 * options.morph_targets


def _every(clip: Clip, step: int) -> Clip:
    """Return every n-th frame of a clip, at the same speed."""
    if step == 1:
        return clip
    motion = replace(
        clip.motion,
        poses=clip.motion.poses[::step],
        translation=clip.motion.translation[::step],
        frame_rate=clip.motion.frame_rate / step,
    )
    return Clip(motion, None if clip.bone_transforms is None else clip.bone_transforms[::step])
