"""An avatar as a character: one canonical mesh, a rig, clips, and few shapes; with what that costs in accuracy."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies.skinning import skin_vertices
from snarfcli.checks import check_number
from snarfcli.errors import UserError
from snarfcli.export.decimate import decimate
from snarfcli.export.deviation import Deviation
from snarfcli.export.influences import dense_weights, few_influences, trial_poses
from snarfcli.export.morphs import ShapeBasis, fit_shapes, spread_frames
from snarfcli.export.rig import (
    Clip,
    LocalTransforms,
    bind_frames,
    clip_transforms,
    decompose,
    local_frames,
    recompose,
)
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.mesh import Mesh, vertex_normals
from snarfcli.meshing.skinned import SkinnedSurface, skinned_surface
from snarfcli.names import unique_names
from snarfcli.progress import progress

if TYPE_CHECKING:
    from snarfcli.models.trained_field import TrainedField

__all__ = [
    "Character",
    "CharacterClip",
    "CharacterOptions",
    "build_character",
    "character_surface",
    "check_avatar",
    "check_options",
]

log = logging.getLogger(__name__)

INFLUENCES = (4, 8)
TRIANGLES = (100, 5_000_000)
MORPH_TARGETS = (0, 64)
RESOLUTIONS = (16, 1024)
# Poses that the components are found from: enough for the few that are kept, and as [S, V, 3] still small.
_MOST_POSES = 150
_MOST_RIG_POSES = 64  # that the weights of few joints are fitted to


@dataclass(frozen=True)
class CharacterOptions:
    """What the character may cost."""

    triangles: int | None = 20000
    """Most triangles; None leaves the surface as it was extracted."""
    influences: int = 4
    """Joints that move one vertex: 4, or 8, which fewer programs read."""
    morph_targets: int = 8
    """Most shapes that are blended for the pose-dependent shape; 0 for the mean shape of the clips."""
    resolution: int = 256
    """Cells along the longest side of the canonical box, from which the surface is extracted."""
    weight_colors: bool = False
    """Whether vertices are coloured by their skinning weights."""


@dataclass(frozen=True, eq=False)
class CharacterClip:
    """One clip as it is written."""

    name: str
    """Its name, once in a character."""
    frame_rate: float
    """Frames a second; the first is at time 0."""
    joints: LocalTransforms
    """Local transforms of T frames."""
    shape_weights: NDArray[np.float32]
    """[T, K] weights of the shapes."""


@dataclass(frozen=True, eq=False)
class Character:
    """What a file holds."""

    mesh: Mesh
    """In the canonical frame, with normals and the full weights."""
    joints: NDArray[np.int64]
    """[V, 4 or 8] joints that move a vertex."""
    weights: NDArray[np.float32]
    """[V, 4 or 8] by how much; rows sum to 1."""
    shapes: ShapeBasis
    """K shapes, whose weights are from 0 to 1; the base is that of `mesh`."""
    bind: NDArray[np.float64]
    """[J, 4, 4] joint frames in the canonical pose."""
    clips: list[CharacterClip]
    """The motions."""
    truncation: Deviation
    """What few influences cost."""
    shape_error: Deviation
    """What the shapes leave of the pose-dependent shape; with none of them, all of it."""
    shape_motion: Deviation
    """How far the pose-dependent shape is from its mean."""
    deviation: Deviation
    """Both together, and what nodes cannot express: the posed character against the avatar's skinned surface."""
    skipped: list[tuple[str, int, str]]
    """Clip, frame and reason where the shape could not be followed; it is blended from the frames around."""


def check_options(options: CharacterOptions) -> None:
    """Refuse settings that cannot be used.

    Raises:
        UserError: for the first one.
    """
    if options.influences not in INFLUENCES:
        raise UserError(f"influences must be {' or '.join(map(str, INFLUENCES))}, got {options.influences}")
    check_number("triangles", options.triangles, *TRIANGLES)
    check_number("morph_targets", options.morph_targets, *MORPH_TARGETS)
    check_number("resolution", options.resolution, *RESOLUTIONS)


def check_avatar(avatar: TrainedField) -> None:
    """Refuse an avatar that cannot be rigged.

    Raises:
        UserError: it has no skinning weights.
    """
    if not avatar.has_skinning_weights:
        raise UserError(
            f"a rig needs skinning weights of canonical points, which model {avatar.config.model.name} does not have; "
            'take an avatar of model=fast_snarf, or write single meshes with "snarf animate"'
        )


def character_surface(avatar: TrainedField, options: CharacterOptions) -> SkinnedSurface:
    """Return the avatar's skinned surface with at most the triangles that are wanted.

    Raises:
        UserError: the avatar has no skinning weights or no surface, or so few triangles cannot be.
    """
    check_avatar(avatar)
    try:
        surface = skinned_surface(avatar, options.resolution)
        if options.triangles is not None and len(surface.mesh.faces) > options.triangles:
            log.info("decimating %d triangles to %d", len(surface.mesh.faces), options.triangles)
            surface = SkinnedSurface(avatar, options.resolution, mesh=_decimated(surface.mesh, options.triangles))
        return _FixedSurface(surface) if avatar.config.condition.name == "none" else surface
    except (EmptySurface, FullSurface) as error:
        raise UserError(f"this avatar has no surface to export: {error}; train it longer, or give another by ckpt=") from None


class _FixedSurface(SkinnedSurface):
    """The surface of a shape that does not depend on the pose: its level set is looked for in the first pose alone."""

    def __init__(self, surface: SkinnedSurface) -> None:
        vars(self).update(vars(surface))
        self._vertices: NDArray[np.float32] | None = None

    def canonical_vertices(self, pose: torch.Tensor) -> NDArray[np.float32]:
        if self._vertices is None:
            self._vertices = super().canonical_vertices(pose)
        return self._vertices


def _decimated(mesh: Mesh, triangles: int) -> Mesh:
    """Return the mesh with fewer triangles; what is wrong with so few is the user's to hear."""
    try:
        return decimate(mesh, triangles)
    except ValueError as error:
        raise UserError(str(error)) from None


def build_character(
    avatar: TrainedField, surface: SkinnedSurface, clips: Sequence[Clip], options: CharacterOptions
) -> Character:
    """Make a character of an avatar in motion.

    Args:
        avatar: gives the skeleton.
        surface: its skinned surface, see `character_surface`.
        clips: at least one; names that come again get a number.
        options: what it may cost.

    Raises:
        UserError: the shape cannot be followed in any frame.
    """
    mesh, parents = surface.mesh, avatar.skeleton.parents
    bind = bind_frames(avatar.skeleton)
    names = unique_names(clip.motion.name or "clip" for clip in clips)
    transforms = [clip_transforms(avatar.skeleton, clip) for clip in clips]
    locals_ = [decompose(local_frames(moved @ bind, parents)) for moved in transforms]
    lengths = [clip.motion.num_frames for clip in clips]
    picked = np.stack([transforms[clip][frame] for clip, frame in spread_frames(lengths, _MOST_RIG_POSES)])
    trials = trial_poses(avatar.skeleton, picked)
    joints, weights = few_influences(mesh.weights, options.influences, mesh.vertices, *trials)
    few = dense_weights(joints, weights, len(parents))
    unbind = np.linalg.inv(bind)

    skipped: dict[tuple[int, int], str] = {}
    spread = spread_frames(lengths, _MOST_POSES)
    known: dict[tuple[int, int], NDArray[np.float32]] = {}
    for clip, frame in progress(spread, desc="shapes", unit="poses"):
        shape = _shape(surface, clips[clip], frame, skipped, (clip, frame))
        if shape is not None:
            known[clip, frame] = shape
    if not known:
        raise UserError(f"no frame has a shape that can be followed ({next(iter(skipped.values()))}); give other motions")
    basis = fit_shapes(np.stack(list(known.values())), options.morph_targets)

    truncation, shape_error, shape_motion, deviation = (Deviation() for _ in range(4))
    shape_weights = [np.full((length, len(basis.targets)), np.nan, np.float32) for length in lengths]
    # Rounded as they are written, so that what is measured is what a reader gets.
    read_back = [recompose(_rounded(local), parents) @ unbind for local in locals_]
    frames = [(clip, frame) for clip, length in enumerate(lengths) for frame in range(length)]
    for clip, frame in progress(frames, desc="clips", unit="frames"):
        shape = known.pop((clip, frame), None)
        if shape is None and (clip, frame) not in skipped:
            shape = _shape(surface, clips[clip], frame, skipped, (clip, frame))
        if shape is None:
            continue
        found = basis.weights(shape)
        shape_weights[clip][frame] = found
        blended = basis.shape(found)
        wanted = skin_vertices(shape, mesh.weights, transforms[clip][frame])
        truncation.add(wanted - skin_vertices(shape, few, transforms[clip][frame]))
        shape_motion.add(shape - basis.base)
        shape_error.add(shape - blended)
        deviation.add(wanted - skin_vertices(blended, few, read_back[clip][frame]))
    basis, shape_weights = basis.within_unit_range([_filled(of_clip) for of_clip in shape_weights])
    base = Mesh(basis.base, mesh.faces, weights=mesh.weights, normals=vertex_normals(basis.base, mesh.faces))
    return Character(
        mesh=base,
        joints=joints,
        weights=weights,
        shapes=basis,
        bind=bind,
        clips=[
            CharacterClip(name, clip.motion.frame_rate, local, of_clip)
            for name, clip, local, of_clip in zip(names, clips, locals_, shape_weights, strict=True)
        ],
        truncation=truncation,
        shape_error=shape_error,
        shape_motion=shape_motion,
        deviation=deviation,
        skipped=[(names[clip], frame, reason) for (clip, frame), reason in sorted(skipped.items())],
    )


def _shape(
    surface: SkinnedSurface, clip: Clip, frame: int, skipped: dict[tuple[int, int], str], key: tuple[int, int]
) -> NDArray[np.float32] | None:
    """Return the canonical shape [V, 3] in one frame; None, with the reason in `skipped`, where it cannot be followed."""
    try:
        shape = surface.canonical_vertices(torch.from_numpy(clip.motion.poses[frame]).float())
    except (EmptySurface, FullSurface) as error:
        skipped[key] = str(error)
        return None
    return np.asarray(shape, dtype=np.float32)


def _filled(weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return weights [T, K] whose missing rows (NaN) are blended from the rows around; zeros if all are missing."""
    if not weights.size:
        return weights
    missing = np.isnan(weights[:, 0])
    if not missing.any():
        return weights
    there = np.flatnonzero(~missing)
    if not len(there):
        return np.zeros_like(weights)
    times = np.arange(len(weights))
    return np.stack([np.interp(times, there, column[there]) for column in weights.T], axis=1).astype(np.float32)


def _rounded(local: LocalTransforms) -> LocalTransforms:
    """Return the transforms in the precision of a file."""
    return replace(local, **{name: getattr(local, name).astype(np.float32).astype(np.float64) for name in vars(local)})
