"""Schedule of pose refinement, during training and for a finished avatar."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from snarfcli.bodies import Skeleton
from snarfcli.fitting.pose_fit import CanonicalPoints, PoseFit
from snarfcli.fitting.refined_poses import RefinedPoses
from snarfcli.meshing.extract import EmptySurface, FullSurface
from snarfcli.meshing.surfaces import canonical_surface
from snarfcli.models.fast_snarf import FastSnarf
from snarfcli.models.file_tensors import read_tensor
from snarfcli.models.trained_field import TrainedField
from snarfcli.progress import progress
from snarfcli.samples.sequence import Frame, SequenceSamples
from snarfcli.samples.store import SampleStore

__all__ = ["PoseRefiner", "require_refinable"]

_RESOLUTION = 64  # of the canonical surface; voxels of 3 cm on a body
_POINTS = 400  # of the avatar that are matched
_FRAMES_AT_ONCE = 16
# Plans of steps. Closest points would undo what the field's distances have reached, so they only serve frames that are far.
_WHEN_NEAR = ("settle",)
_WHEN_FAR = ("approach",) * 3
_SETTLE_EVERY = 2  # steps: with 1, the poses were no better
_AT_THE_END = ("settle",) * 3
_FROM_THE_START = ("approach",) * 6 + ("settle",) * 6


def require_refinable(avatar: TrainedField, store: SampleStore, setting: str) -> None:
    """Check that poses of samples can be refined with an avatar.

    Args:
        avatar: trained or not.
        store: samples.
        setting: name of the setting that asks for it, for the message.

    Raises:
        ValueError: the system has no forward skinning, or the samples are planar.
    """
    if not isinstance(avatar.model, FastSnarf):
        name = avatar.config.model.name
        raise ValueError(f"{setting}: wanted model fast_snarf or snarf, got {name}, which has no forward skinning")
    if store.is_planar:
        raise ValueError(f"{setting}: wanted samples of surfaces in space, got planar ones; leave it out")


class PoseRefiner:
    """Refine the poses of sequences with an avatar.

    Args:
        sequences: samples; from now on their poses are the refined ones.
        skeleton: of the avatar.
        device: on which to compute.
        seed: of random numbers.
    """

    def __init__(self, sequences: Sequence[SequenceSamples], skeleton: Skeleton, device: torch.device, seed: int) -> None:
        self.poses = RefinedPoses(sequences, skeleton, device)
        self._seed = seed
        self._points: CanonicalPoints | None = None

    def renew_points(self, avatar: TrainedField) -> None:
        """Match the frames of coming training steps with the present surface of an avatar; with the old one if it has none."""
        self._points = self._points_of(avatar) or self._points

    def refine(self, model: FastSnarf, frames: Sequence[Frame], step: int, precision: str) -> None:
        """Refine the poses of the frames of a training step; they take effect without the common part of the corrections."""
        plans = {False: _WHEN_FAR} | ({True: _WHEN_NEAR} if step % _SETTLE_EVERY == 0 else {})
        for near, plan in plans.items():
            some = [frame for frame in frames if self.poses.is_near(frame) == near]
            self._refine(model, self._points, some, plan, precision, centred=True)

    def refine_all(self, avatar: TrainedField, frames: Sequence[Frame], *, desc: str) -> None:
        """Refine the poses of many frames with a finished avatar: with more steps those that are not near it yet.

        Args:
            avatar: a system with forward skinning.
            frames: of the sequences.
            desc: label of the progress line.
        """
        assert isinstance(avatar.model, FastSnarf)
        points = self._points_of(avatar)
        parts = []
        for near, plan in ((True, _AT_THE_END), (False, _FROM_THE_START)):
            chosen = [frame for frame in frames if self.poses.is_near(frame) == near]
            parts += [(plan, chosen[first : first + _FRAMES_AT_ONCE]) for first in range(0, len(chosen), _FRAMES_AT_ONCE)]
        for plan, part in progress(parts, desc=desc, unit="batches"):
            self._refine(avatar.model, points, part, plan, "highest", centred=False)

    def _points_of(self, avatar: TrainedField) -> CanonicalPoints | None:
        """Return points on the canonical surface of an avatar, equally many for every bone; None if it has no surface."""
        pose = torch.as_tensor(np.concatenate([s.poses for s in self.poses.sequences]).mean(0))
        try:
            mesh = canonical_surface(avatar, pose.float(), _RESOLUTION)
        except (EmptySurface, FullSurface):
            return None
        random = np.random.default_rng(self._seed)
        owner = mesh.skinning_weights.argmax(1)
        bones = np.unique(owner)
        chosen = np.concatenate([random.choice(np.flatnonzero(owner == bone), -(-_POINTS // len(bones))) for bone in bones])
        values = (mesh.vertices[chosen], mesh.unit_normals[chosen], mesh.skinning_weights[chosen])
        return CanonicalPoints(*(torch.as_tensor(v, dtype=torch.float32, device=avatar.device) for v in values))

    def _refine(
        self,
        model: FastSnarf,
        points: CanonicalPoints | None,
        frames: Sequence[Frame],
        plan: Sequence[str],
        precision: str,
        *,
        centred: bool,
    ) -> None:
        """Take the steps of a plan; see `RefinedPoses.refine`."""
        if frames and points is not None:
            self.poses.refine(PoseFit(model, self.poses.skeleton, precision), points, frames, plan, centred=centred)

    def finish(self, avatar: TrainedField) -> None:
        """Refine the poses of all frames once more, with the finished avatar; those out of its reach keep the given poses."""
        frames = [(sequence, frame) for sequence in self.poses.sequences for frame in range(sequence.num_frames)]
        self.refine_all(avatar, frames, desc="refine poses")
        self.poses.give_up_misfits()

    def state(self) -> dict[str, Any]:
        """Return what a resumed run needs."""
        points = None if self._points is None else {name: value.cpu() for name, value in vars(self._points).items()}
        return {**self.poses.state(), "points": points}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`.

        Raises:
            KeyError, TypeError, ValueError, AttributeError: the state does not fit the sequences.
        """
        self.poses.restore(state)
        points = state["points"]
        if points is not None:
            columns = {"points": 3, "normals": 3, "weights": self.poses.skeleton.num_joints}
            count = len(points["points"])
            read = {name: read_tensor(points[name], name, (count, width)) for name, width in columns.items()}
            points = CanonicalPoints(**{name: value.to(self.poses.device) for name, value in read.items()})
        self._points = points
