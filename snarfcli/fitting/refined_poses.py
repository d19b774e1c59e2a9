"""Refined poses of whole sequences of samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from snarfcli.bodies import Skeleton
from snarfcli.errors import UserError
from snarfcli.files import write_arrays
from snarfcli.fitting.corrections import Corrections, Corrector, bone_turns
from snarfcli.fitting.pose_fit import CanonicalPoints, FittedPoses, PoseFit, Surfaces
from snarfcli.models.file_tensors import read_tensor
from snarfcli.samples.sequence import Frame, SequenceSamples
from snarfcli.sampling import oriented_surface_samples
from snarfcli.texts import counted

__all__ = ["RefinedPoses", "refined_poses_text"]

_LEAST_MATCHED = 0.5  # share of the points on a mesh; with fewer the pose counts as not refined
_NEAR = 0.005  # of the longest side of the subject's box: 9 mm for a person; closest points alone reach 6 mm
_MISFIT = 0.006  # of the longest side of the subject's box: 1 cm for a person; refined poses reach a fifth of it
_UNMATCHED_M = 1.0  # reported for a mesh without any match
_KEPT_FRAMES = 4096  # whose points are kept, 24 kB each
_POINTS = 1000  # on the mesh of a frame


def refined_poses_text(summary: Mapping[str, float]) -> str:
    """Return the content of `RefinedPoses.summary` as one line."""
    if not summary:
        return "poses: none was refined"
    frames = counted(int(summary["frames"]), "frame")
    return (
        f"poses of {frames} refined: turned by {summary['turn_deg']:.1f} degrees per joint and moved by "
        f"{100 * summary['shift_m']:.1f} cm (means); meshes are {1000 * summary['distance_m']:.1f} mm from the avatar (median)"
    )


class RefinedPoses:
    """Corrections of the poses of sequences, which take effect in the sequences themselves.

    Args:
        sequences: samples; from now on their poses and bone transforms are the corrected ones.
        skeleton: of the subject.
        device: on which to compute.
    """

    def __init__(self, sequences: Sequence[SequenceSamples], skeleton: Skeleton, device: torch.device) -> None:
        self.sequences, self.skeleton, self.device = list(sequences), skeleton, device
        self._corrector = Corrector(skeleton, torch.device("cpu"))
        self._start = np.concatenate([[0], np.cumsum([sequence.num_frames for sequence in sequences])])
        self._place = {id(sequence): index for index, sequence in enumerate(self.sequences)}
        sizes = [np.ptp(s.box(frame), axis=0).max() for s in self.sequences for frame in range(s.num_frames)]
        self.size_m = float(np.median(sizes))
        """Longest side of the subject's box in a frame, median over the frames, metres."""
        self._drawn: dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}
        self._given = [(s.poses.copy(), s.bone_transforms.copy(), s.translation.copy()) for s in self.sequences]
        self._are_trained = torch.cat([torch.arange(s.num_frames) < len(s.train_frames) for s in self.sequences])
        self.corrections = Corrections.none(int(self._start[-1]), skeleton.num_joints, torch.zeros(0))
        """Of all F frames, the common part included."""
        self._in_effect = Corrections.none(int(self._start[-1]), skeleton.num_joints, torch.zeros(0))
        roots = np.concatenate([s.bone_transforms[:, 0] for s in self.sequences])
        self._root_axes = bone_turns(torch.as_tensor(roots, dtype=torch.float32))
        self.distance_m = torch.full((int(self._start[-1]),), torch.nan)
        """[F], mean distance between mesh and avatar when a frame was last refined, metres; NaN if it never was."""

    # ---------------------------------------------------------------- refining
    def refine(
        self, fit: PoseFit, avatar: CanonicalPoints, frames: Sequence[Frame], plan: Sequence[str], *, centred: bool
    ) -> None:
        """Refine the poses of some frames, starting from their present corrections.

        Args:
            fit: of the avatar.
            avatar: points of its canonical surface.
            frames: of the sequences.
            plan: kinds of steps to take, "approach" or "settle".
            centred: whether the poses take effect without the common part of the corrections. An avatar that is trained with
                them then moves to where this part is zero.
        """
        rows = self._rows(frames)
        seen = self._seen(frames)
        transforms, pose = self._given_poses(frames)
        corrections = self.corrections.take(rows).to(self.device)
        fitted: FittedPoses | None = None
        for kind in plan:
            step = fit.approach if kind == "approach" else fit.settle
            fitted = step(avatar, seen, transforms, pose, corrections)
            corrections = fitted.corrections
        if fitted is not None:
            corrections = corrections.to(torch.device("cpu"))
            self.corrections.put(rows, corrections)
            self.distance_m[rows] = fitted.distance.where(fitted.matched > _LEAST_MATCHED, torch.inf).cpu()
            self._in_effect.put(rows, self._centred(corrections, rows) if centred else corrections)
            self._take_effect(frames, rows)

    def forget(self, frames: Sequence[Frame]) -> None:
        """Give frames the poses back that they came with, as if they had never been refined."""
        rows = self._rows(frames)
        self.distance_m[rows] = torch.nan
        self._reset(frames, rows)

    def give_up_misfits(self) -> None:
        """Give the frames that could not be refined the poses back that they came with; `count_misfits` still counts them."""
        rows = (self.distance_m > self.misfit_m).nonzero()[:, 0]
        if len(rows):
            self._reset(self._frames_of(rows), rows)

    def _reset(self, frames: Sequence[Frame], rows: Tensor) -> None:
        none = Corrections.none(len(rows), self.skeleton.num_joints, self.corrections.turn)
        self.corrections.put(rows, none)
        self._in_effect.put(rows, none)
        joints = self._corrector.joints(self._given_poses(frames)[0].cpu()).numpy()
        for number, (sequence, frame) in enumerate(frames):
            poses, transforms, translation = self._given[self._place[id(sequence)]]
            sequence.poses[frame], sequence.bone_transforms[frame] = poses[frame], transforms[frame]
            sequence.translation[frame], sequence.joints[frame] = translation[frame], joints[number]

    def common_part(self) -> Corrections:
        """Return the mean of the corrections of training frames made so far, the shift in the axes of the root.

        The same turn of a bone in every frame, or the same shift in the axes of the root, can as well be a change of the
        canonical shape, so no frame determines it.
        """
        done = (self._are_trained & self.distance_m.isfinite()).nonzero()[:, 0]
        if not len(done):
            return Corrections.none(1, self.skeleton.num_joints, self.corrections.turn)
        shift = (self._root_axes[done].transpose(1, 2) @ self.corrections.shift[done, :, None])[..., 0]
        return Corrections(self.corrections.turn[done].mean(0, keepdim=True), shift.mean(0, keepdim=True))

    def is_near(self, frame: Frame) -> bool:
        """Return whether a mesh was near the avatar when its pose was last refined; for frames that never were, False."""
        return bool((self.distance_m[self._rows([frame])] < _NEAR * self.size_m).all())

    def _rows(self, frames: Sequence[Frame]) -> Tensor:
        return torch.tensor([int(self._start[self._place[id(sequence)]]) + frame for sequence, frame in frames])

    def _frames_of(self, rows: Tensor) -> list[Frame]:
        index = np.searchsorted(self._start, rows.numpy(), "right") - 1
        return [(self.sequences[i], int(row - self._start[i])) for i, row in zip(index, rows.tolist(), strict=True)]

    def _transforms_of(self, frame: Frame) -> NDArray[np.float32]:
        """Return the bone transforms [J, 4, 4] that were given for a frame."""
        return self._given[self._place[id(frame[0])]][1][frame[1]]

    def _given_poses(self, frames: Sequence[Frame]) -> tuple[Tensor, Tensor]:
        """Return the bone transforms [B, J, 4, 4] and poses [B, J, 3] that were given."""
        transforms = np.stack([self._transforms_of(frame) for frame in frames])
        poses = np.stack([self._given[self._place[id(sequence)]][0][frame] for sequence, frame in frames])
        return torch.as_tensor(transforms, device=self.device).float(), torch.as_tensor(poses, device=self.device).float()

    def _seen(self, frames: Sequence[Frame]) -> Surfaces:
        """Return random points on the meshes of some frames."""
        drawn = [self._seen_in(int(row), frame) for row, frame in zip(self._rows(frames), frames, strict=True)]
        points, normals = (torch.as_tensor(np.stack(values), device=self.device) for values in zip(*drawn, strict=True))
        return Surfaces(points, normals)

    def _seen_in(self, row: int, frame: Frame) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return random points on the mesh of a frame and the normals there, both [N, 3]; the same points in every call."""
        if row in self._drawn:
            return self._drawn[row]
        sequence, index = frame
        generator = np.random.default_rng([row, len(self.distance_m)])
        try:
            points, normals = oriented_surface_samples(sequence.vertices(index), sequence.faces(index), _POINTS, generator)
        except UserError as error:
            raise UserError(f"{sequence.name}, frame {sequence.frame_numbers[index]}: {error}") from None
        drawn = points.astype(np.float32), normals.astype(np.float32)
        if len(self._drawn) < _KEPT_FRAMES:
            self._drawn[row] = drawn
        return drawn

    def _centred(self, corrections: Corrections, rows: Tensor) -> Corrections:
        """Return the corrections of some frames without the common part of all."""
        common = self.common_part()
        shift = (self._root_axes[rows] @ common.shift[..., None])[..., 0]
        return Corrections(corrections.turn - common.turn, corrections.shift - shift)

    def _take_effect(self, frames: Sequence[Frame], rows: Tensor) -> None:
        """Write the poses with the corrections in effect into the sequences."""
        transforms, pose = (values.cpu() for values in self._given_poses(frames))
        corrections = self._in_effect.take(rows)
        moved, turned = self._corrector.correct(transforms, pose, corrections)
        joints = self._corrector.joints(moved)
        for number, (sequence, frame) in enumerate(frames):
            given = self._given[self._place[id(sequence)]]
            sequence.poses[frame] = turned[number].numpy()
            sequence.bone_transforms[frame] = moved[number].numpy()
            sequence.joints[frame] = joints[number].numpy()
            sequence.translation[frame] = given[2][frame] + corrections.shift[number].numpy()

    # ---------------------------------------------------------------- results
    @property
    def num_frames(self) -> int:
        """F, the number of frames of all sequences."""
        return len(self.distance_m)

    @property
    def misfit_m(self) -> float:
        """Mean distance between mesh and avatar from which a pose counts as not refined, metres."""
        return _MISFIT * self.size_m

    def count_misfits(self) -> int:
        """Return the number of refined frames whose mesh is far from the avatar, or was not matched at all."""
        return int((self.distance_m > self.misfit_m).sum())

    def summary(self) -> dict[str, float]:
        """Return by how much poses were corrected, and how far the avatar is from the meshes; empty if none was refined."""
        done = ~self.distance_m.isnan()
        if not bool(done.any()):
            return {}
        distance = self.distance_m[done].clamp_max(_UNMATCHED_M)
        degrees = torch.rad2deg(self.corrections.turn[done].norm(dim=-1).mean())
        return {
            "frames": int(done.sum()),
            "turn_deg": round(float(degrees), 3),
            "shift_m": round(float(self.corrections.shift[done].norm(dim=-1).mean()), 5),
            "distance_m": round(float(distance.median()), 5),
            "distance_p95_m": round(float(distance.quantile(0.95)), 5),
        }

    def write(self, path: Path) -> None:
        """Write the poses of all frames to an `.npz`, in the layout of pose files (`datasets.skeleton_files`).

        It also holds the skeleton, and per frame the name of its sequence and its number there.
        """
        skeleton = self.skeleton
        write_arrays(
            path,
            {
                "poses": np.concatenate([s.poses for s in self.sequences]),
                "trans": np.concatenate([s.translation for s in self.sequences]),
                "frame_rate": np.array(self.sequences[0].frame_rate),
                "sequences": np.concatenate([np.full(s.num_frames, s.name) for s in self.sequences]),
                "frames": np.concatenate([s.frame_numbers for s in self.sequences]),
                "names": np.array(skeleton.names),
                "parents": np.array(skeleton.parents),
                "joints_rest": skeleton.joints_rest.numpy(),
                "canonical_pose": skeleton.canonical_pose.numpy(),
            },
        )

    def state(self) -> dict[str, Any]:
        """Return what a resumed run needs."""
        return {name: value.clone() for name, value in self._values().items()}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`.

        Raises:
            KeyError, TypeError, ValueError, AttributeError: the state does not fit the sequences.
        """
        for name, mine in self._values().items():
            # the distance of a frame is NaN before it is refined, and infinite where nothing matches
            theirs = state[name].nan_to_num(posinf=0.0) if name == "distance" else state[name]
            read_tensor(theirs, f"poses.{name}", mine.shape)
            mine.copy_(state[name])
        done = (~self.distance_m.isnan()).nonzero()[:, 0]
        if len(done):
            self._take_effect(self._frames_of(done), done)

    def _values(self) -> dict[str, Tensor]:
        """Return all that changes, by name."""
        found, effect = self.corrections, self._in_effect
        return {
            "turn": found.turn,
            "shift": found.shift,
            "turn_in_effect": effect.turn,
            "shift_in_effect": effect.shift,
            "distance": self.distance_m,
        }
