"""The built-in subjects in clothes: the same ids, motions and splits, with folds that depend on the pose.

The template is the body below the clothes in the canonical pose, as in CAPE: a system that needs a skinned base mesh gets the
body without clothes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import Body, axis_angle_to_matrix, builtin_body, find_body, load_body
from snarfcli.bodies.skinning import blend_transforms, transform_points
from snarfcli.datasets.builtin import BUILTIN_SUBJECTS, builtin_subject, require_subject
from snarfcli.datasets.folds import Folds, place_folds
from snarfcli.datasets.garment import ClothedMesh, Outfit, dress
from snarfcli.datasets.posed_meshes import ArrayMeshes, BodyMeshes
from snarfcli.datasets.sources import Request
from snarfcli.datasets.subjects import SubjectData

__all__ = ["ClothedBody", "ClothedMeshes", "clothed_subject", "load", "outfit_of", "subjects"]


def subjects(request: Request) -> tuple[str, ...]:
    """Return the ids of the built-in subjects."""
    return BUILTIN_SUBJECTS


def load(subject: str, request: Request) -> SubjectData:
    """Return a built-in subject in clothes, with the built-in body or the requested one."""
    if request.body is None:
        return clothed_subject(subject)
    require_subject(subject)
    path = find_body(request.body, "smpl", "neutral")
    return clothed_subject(subject, load_body(path), f"body {path}")


def outfit_of(subject: str) -> Outfit:
    """Return the outfit of a built-in subject; it depends only on the id."""
    random = np.random.default_rng([int(subject), 4])
    has_long_legs, has_long_sleeves = divmod(BUILTIN_SUBJECTS.index(subject) % 4, 2)
    return Outfit(
        sleeve=random.uniform(0.78, 0.9) if has_long_sleeves else random.uniform(0.26, 0.36),
        leg=random.uniform(0.78, 0.88) if has_long_legs else random.uniform(0.3, 0.38),
        shirt_length=random.uniform(1.0, 1.2),
        stand_off_m=random.uniform(0.018, 0.024),
        flare_m=random.uniform(0.018, 0.026),
    )


def clothed_subject(subject: str | int, body: Body | None = None, source: str = "") -> SubjectData:
    """Return a built-in subject in clothes; the result depends only on the arguments.

    Args:
        subject: one of the built-in ids.
        body: an SMPL body instead of the built-in one.
        source: origin of that body, for the manifest.

    Raises:
        UserError: there is no such subject, or the body does not fit the motions.
    """
    bare = builtin_subject(subject, body, source)
    clothed = ClothedBody(body or builtin_body(), bare)
    sequences = []
    for sequence in bare.sequences:
        assert isinstance(sequence.meshes, BodyMeshes)
        sequences.append(replace(sequence, meshes=ClothedMeshes(clothed, sequence.meshes.poses, sequence.meshes.translation)))
    outfit = outfit_of(bare.subject)
    lengths = ["long" if share > 0.5 else "short" for share in (outfit.sleeve, outfit.leg)]
    clothes = f"clothes fitted to the body: a shirt with {lengths[0]} sleeves, {lengths[1]} trousers"
    return replace(bare, data="clothed", sequences=tuple(sequences), sources=(*bare.sources, clothes))


class ClothedBody:
    """A subject in clothes, in any pose. The clothes are computed at first use, which takes some seconds.

    Args:
        body: the body model.
        bare: the subject without clothes.
    """

    def __init__(self, body: Body, bare: SubjectData) -> None:
        self.body, self.bare = body.to(torch.float64), bare

    @property
    def mesh(self) -> ClothedMesh:
        """The closed mesh of cloth and skin in the canonical pose, without folds."""
        return self._made[0]

    @property
    def folds(self) -> Folds:
        """The folds of the cloth."""
        return self._made[-1]

    def pose(self, poses: NDArray, translation: NDArray | None = None) -> NDArray[np.float64]:
        """Return the vertices of cloth and skin, [B, V, 3], metres.

        Args:
            poses: [B, J, 3], axis-angle, radians, global orientation first.
            translation: [B, 3], metres, none by default.
        """
        mesh, weights, rest, facing, folds = self._made
        skeleton = self.bare.skeleton
        posed_from_rest = skeleton.posed_from_rest(torch.as_tensor(poses, dtype=torch.float64)).numpy()
        height = folds.displacement(self.turned(poses))
        vertices = np.empty((len(poses), len(rest), 3))
        corrected = self._correctives(poses) - self._correctives(skeleton.canonical_pose.numpy()[None])
        for index in range(len(poses)):  # one at a time, since the transforms of all vertices are large
            blended = blend_transforms(weights, posed_from_rest[index])
            local = rest + mesh.follow(corrected[index]) + facing * height[index, :, None]
            vertices[index] = transform_points(blended, local)
        return vertices if translation is None else vertices + np.asarray(translation)[:, None]

    def turned(self, poses: NDArray) -> NDArray[np.float64]:
        """Return the rotations [B, J, 3, 3] of the joints from the canonical pose, in the axes of their parents."""
        from_rest = axis_angle_to_matrix(torch.as_tensor(poses, dtype=torch.float64))
        canonical = axis_angle_to_matrix(self.bare.skeleton.canonical_pose.to(torch.float64))
        return (from_rest @ canonical.transpose(-1, -2)).numpy()

    def _correctives(self, poses: NDArray) -> NDArray[np.float64]:
        """Return the pose correctives [B, V', 3] of the body, metres, in the rest pose."""
        body = self.body
        rotations = axis_angle_to_matrix(torch.as_tensor(poses, dtype=torch.float64)[:, 1:])
        feature = (rotations - torch.eye(3, dtype=torch.float64)).reshape(len(poses), -1)
        if not body.posedirs.shape[-1]:
            return np.zeros((len(poses), len(body.v_template), 3))
        return (feature @ body.posedirs.reshape(-1, body.posedirs.shape[-1]).T).reshape(len(poses), -1, 3).numpy()

    @property
    def _made(self) -> tuple[ClothedMesh, NDArray, NDArray, NDArray, Folds]:
        if not hasattr(self, "_kept"):
            self._kept = self._make()
        return self._kept

    def _make(self) -> tuple[ClothedMesh, NDArray, NDArray, NDArray, Folds]:
        """Compute the garment.

        Returns:
            mesh: cloth and skin in the canonical pose.
            weights: [V, J], skinning weights.
            rest: [V, 3], vertices in the rest pose, metres.
            facing: [V, 3], directions in which folds move the vertices, rest pose.
            folds: the folds.
        """
        skeleton, template = self.bare.skeleton, self.bare.template
        assert template is not None  # built-in subjects have one
        joints = dict(zip(skeleton.names, skeleton.canonical_joints.to(torch.float64).numpy(), strict=True))
        mesh = dress(template.vertices, template.faces, joints, outfit_of(self.bare.subject))
        weights = mesh.follow(template.weights)
        # Away from the body vertices that are followed: like a normal, but also smooth at hems.
        away = mesh.vertices - mesh.follow(template.vertices)
        facing = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
        folds = place_folds(mesh.vertices, facing, mesh.stand_off_m, joints, int(self.bare.subject))
        canonical = skeleton.posed_from_rest(skeleton.canonical_pose[None].to(torch.float64))[0].numpy()
        rest_from_canonical = np.linalg.inv(blend_transforms(weights, canonical))
        rest = transform_points(rest_from_canonical, mesh.vertices)
        return mesh, weights, rest, np.einsum("vij,vj->vi", rest_from_canonical[:, :3, :3], facing), folds


class ClothedMeshes:
    """A subject in clothes in the poses of a motion; posed when frames are chosen.

    Args:
        clothed: the subject.
        poses: [T, J, 3], axis-angle, radians.
        translation: [T, 3], metres.
    """

    def __init__(self, clothed: ClothedBody, poses: NDArray, translation: NDArray) -> None:
        self.clothed, self.poses, self.translation = clothed, poses, translation

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, index: int) -> tuple[NDArray, NDArray]:
        return self.chosen(np.array([index]))[0]

    def chosen(self, frames: NDArray[np.int64]) -> ArrayMeshes:
        vertices = self.clothed.pose(self.poses[frames], self.translation[frames])
        return ArrayMeshes(vertices.astype(np.float32), self.clothed.mesh.faces.astype(np.int32))

    def source(self, index: int) -> str:
        return ""

    def fingerprint(self) -> str:
        return ""
