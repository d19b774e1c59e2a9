"""Build a character from an avatar and its motions: fit influences and morph targets, and measure their errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import Skeleton
from snarfcli.bodies.skinning import skin_vertices, transform_points
from snarfcli.errors import UserError
from snarfcli.export.character import Character, CharacterClip, CharacterErrors, CharacterOptions
from snarfcli.export.clips import Clip, clip_transforms
from snarfcli.export.influences import dense_weights, few_influences, trial_poses
from snarfcli.export.morphs import ShapeBasis, fit_shapes, spread_frames
from snarfcli.export.rig import LocalTransforms, Stance, canonical_stance, decompose, local_frames, recompose
from snarfcli.export.stored_shape import stored_transforms
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.mesh import Mesh, vertex_normals
from snarfcli.meshing.skinned import SkinnedSurface
from snarfcli.models.trained_field import TrainedField
from snarfcli.names import unique_names
from snarfcli.progress import progress

__all__ = ["build_character"]

# Poses from which the morph targets are found: enough for the few that are kept, and small in memory as [S, V, 3].
_MOST_POSES = 150
_MOST_RIG_POSES = 64  # poses to which the weights of few joints are fitted

_Frame = tuple[int, int]
"""Number of a clip, and of a frame in it."""


def build_character(
    avatar: TrainedField,
    surface: SkinnedSurface,
    clips: Sequence[Clip],
    options: CharacterOptions,
    stance: Stance | None = None,
) -> Character:
    """Build a character from an avatar in motion.

    Args:
        avatar: gives the skeleton.
        surface: its skinned surface, see `character_surface`.
        clips: at least one; repeated names get a number.
        options: limits on its size.
        stance: pose of the stored mesh and joints; the canonical pose by default. In any other pose the mesh is stored as all
            weights move it there, and linear blend skinning from there differs a little from the avatar's, which is part of
            the deviation. Only with the canonical pose are the weights of the morph targets from 0 to 1; otherwise each
            component has one target per direction, and the weights of the mean shape are 0.

    Raises:
        UserError: the shape cannot be followed in any frame.
    """
    mesh, parents = surface.mesh, avatar.skeleton.parents
    assert mesh.weights is not None
    is_canonical = stance is None
    stance = canonical_stance(avatar.skeleton) if stance is None else stance
    bind, frames = stance.frames, np.linalg.inv(stance.from_canonical) @ stance.frames
    transforms = [clip_transforms(avatar.skeleton, clip) for clip in clips]
    local = [decompose(local_frames(moved @ frames, parents)) for moved in transforms]
    joints, weights = _fit_influences(avatar.skeleton, mesh, transforms, options.influences)
    shapes = _FrameShapes(surface, clips)
    basis = fit_shapes(shapes.sample(_MOST_POSES), options.morph_targets)

    few = dense_weights(joints, weights, len(parents))
    picked = spread_frames([len(of_clip) for of_clip in transforms], _MOST_RIG_POSES)
    poses = np.stack([transforms[clip][frame] for clip, frame in picked])
    stored = None if is_canonical else stored_transforms(mesh.weights, few, poses, stance)
    skins = _Skins(
        exact=_Skin(mesh.weights, transforms),
        truncated=_Skin(few, transforms),
        written=_Skin(few, [_read_back(moved, parents) @ np.linalg.inv(bind) for moved in local], stored),
    )
    errors, shape_weights = _play(shapes, basis, skins)
    basis, shape_weights = basis.within_unit_range(shape_weights) if is_canonical else basis.two_sided(shape_weights)
    basis = basis if stored is None else _moved(basis, stored)
    names = unique_names(clip.motion.name or "clip" for clip in clips)
    return Character(
        mesh=Mesh(basis.base, mesh.faces, weights=mesh.weights, normals=vertex_normals(basis.base, mesh.faces)),
        joints=joints,
        weights=weights,
        shapes=basis,
        bind=bind,
        clips=[
            CharacterClip(name, clip.motion.frame_rate, joint_tracks, weight_tracks)
            for name, clip, joint_tracks, weight_tracks in zip(names, clips, local, shape_weights, strict=True)
        ],
        errors=errors,
        skipped=[(names[clip], frame, reason) for (clip, frame), reason in sorted(shapes.skipped.items())],
    )


def _fit_influences(
    skeleton: Skeleton, mesh: Mesh, transforms: Sequence[NDArray[np.float64]], count: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return `count` joints [V, count] per vertex and their weights [V, count], fitted to poses of the clips."""
    assert mesh.weights is not None
    picked = spread_frames([len(of_clip) for of_clip in transforms], _MOST_RIG_POSES)
    trials = trial_poses(skeleton, np.stack([transforms[clip][frame] for clip, frame in picked]))
    return few_influences(mesh.weights, count, mesh.vertices, *trials)


class _FrameShapes:
    """The canonical shapes of the frames of clips, each computed once."""

    def __init__(self, surface: SkinnedSurface, clips: Sequence[Clip]) -> None:
        self._surface, self._clips = surface, clips
        self._sampled: dict[_Frame, NDArray[np.float32]] = {}
        self.lengths = [clip.motion.num_frames for clip in clips]
        """Number of frames per clip."""
        self.skipped: dict[_Frame, str] = {}
        """Frames whose shape cannot be followed, and why."""

    def sample(self, count: int) -> NDArray[np.float32]:
        """Return the shapes [S, V, 3] of at most `count` frames, evenly spread over the clips, and keep them for `take`.

        Raises:
            UserError: none of them can be followed.
        """
        for key in progress(spread_frames(self.lengths, count), desc="shapes", unit="poses"):
            shape = self._compute(key)
            if shape is not None:
                self._sampled[key] = shape
        if not self._sampled:
            reason = next(iter(self.skipped.values()))
            raise UserError(f"no frame has a shape that can be followed ({reason}); give other motions")
        return np.stack(list(self._sampled.values()))

    def take(self, key: _Frame) -> NDArray[np.float32] | None:
        """Return the shape [V, 3] of a frame, and no longer keep it; None where it cannot be followed."""
        if key in self._sampled:
            return self._sampled.pop(key)
        return None if key in self.skipped else self._compute(key)

    def _compute(self, key: _Frame) -> NDArray[np.float32] | None:
        clip, frame = key
        try:
            shape = self._surface.canonical_vertices(torch.from_numpy(self._clips[clip].motion.poses[frame]).float())
        except (EmptySurface, FullSurface) as error:
            self.skipped[key] = str(error)
            return None
        return np.asarray(shape, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class _Skin:
    """Weights and bone transforms of all frames."""

    weights: NDArray
    """[V, J]."""
    transforms: Sequence[NDArray[np.float64]]
    """Per clip [T, J, 4, 4], from the stored to the posed shape, metres."""
    stored: NDArray[np.float64] | None = None
    """[V, 3, 4] transform of each vertex from the canonical to the stored shape; None if the canonical shape is stored."""

    def posed(self, shape: NDArray, key: _Frame) -> NDArray:
        """Return a canonical shape [V, 3] posed as in a frame, [V, 3] metres."""
        clip, frame = key
        shape = shape if self.stored is None else transform_points(self.stored, shape)
        return skin_vertices(shape, self.weights, self.transforms[clip][frame])


@dataclass(frozen=True, eq=False)
class _Skins:
    """The skin of an avatar and of its character."""

    exact: _Skin
    """Skin of the avatar."""
    truncated: _Skin
    """The same with few influences."""
    written: _Skin
    """Few influences, and transforms as read from the file."""


def _play(shapes: _FrameShapes, basis: ShapeBasis, skins: _Skins) -> tuple[CharacterErrors, list[NDArray[np.float32]]]:
    """Go through all frames once; return the errors, and per clip the weights [T, K] of the morph targets."""
    errors = CharacterErrors()
    weights = [np.full((length, len(basis.targets)), np.nan, np.float32) for length in shapes.lengths]
    frames = [(clip, frame) for clip, length in enumerate(shapes.lengths) for frame in range(length)]
    for key in progress(frames, desc="clips", unit="frames"):
        shape = shapes.take(key)
        if shape is None:
            continue
        clip, frame = key
        weights[clip][frame] = found = basis.weights(shape)
        blended = basis.shape(found)
        wanted = skins.exact.posed(shape, key)
        errors.truncation.add(wanted - skins.truncated.posed(shape, key))
        errors.shape_motion.add(shape - basis.base)
        errors.shape_error.add(shape - blended)
        errors.deviation.add(wanted - skins.written.posed(blended, key))
    return errors, [_filled(of_clip) for of_clip in weights]


def _filled(weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return weights [T, K] with missing rows (NaN) interpolated from the rows around; zeros if all are missing."""
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


def _moved(basis: ShapeBasis, transforms: NDArray[np.float64]) -> ShapeBasis:
    """Return a basis whose vertices were moved by transforms [V, 3, 4], and its targets with them."""
    base = transform_points(transforms, basis.base)
    targets = np.einsum("vab,kvb->kva", transforms[..., :3], basis.targets)
    return ShapeBasis(base.astype(np.float32), targets.astype(np.float32), basis.rest)


def _read_back(local: LocalTransforms, parents: Sequence[int]) -> NDArray[np.float64]:
    """Return the joint frames [T, J, 4, 4] that a reader computes from transforms rounded to the precision of a file."""
    rounded = {name: getattr(local, name).astype(np.float32).astype(np.float64) for name in vars(local)}
    return recompose(replace(local, **rounded), parents)
