"""The runs of a plan as figures need them: which of them to draw, their avatars and samples, and predicted surfaces."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch

from snarfcli.avatar import Avatar
from snarfcli.errors import UserError
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.surfaces import field_surface
from snarfcli.reproduce.experiments import Row
from snarfcli.reproduce.plans import Plan
from snarfcli.reproduce.results import Result
from snarfcli.samples.sequence import SequenceSamples
from snarfcli.samples.store import SampleStore

__all__ = ["load_avatar", "open_samples", "predicted_surface", "trained_runs"]

log = logging.getLogger(__name__)


def trained_runs(plan: Plan, results: Sequence[Result]) -> list[tuple[Row, Result]]:
    """Return rows with a trained run each, all of one subject and seed: those for which most rows are trained."""
    trained = [result for result in results if "train" in result.files]
    if not trained:
        return []
    counts: dict[tuple[str, int], int] = {}
    for result in trained:
        key = (result.job.subject, result.job.seed)
        counts[key] = counts.get(key, 0) + 1
    chosen = max(counts, key=lambda key: counts[key])  # the first of several equals
    of_row = {result.job.row: result for result in trained if (result.job.subject, result.job.seed) == chosen}
    return [(row, of_row[row.key]) for row in plan.experiment.rows if row.key in of_row]


def load_avatar(result: Result) -> Avatar | None:
    """Return the avatar of a run; None, with a warning, if it cannot be read. Its panel then stays empty."""
    try:
        return Avatar.load(result.job.folder)
    except UserError as error:
        log.warning("warning: cannot draw %s: %s", result.job.name, error)
        return None


def open_samples(result: Result, split: str) -> SampleStore:
    """Return the samples of a split on which a run is evaluated."""
    evaluation = next(one for one in result.job.evaluations if one.split == split)
    return SampleStore.open(evaluation.data_root, evaluation.data, result.job.subject)


def predicted_surface(avatar: Avatar, sequence: SequenceSamples, index: int, resolution: int) -> Mesh | None:
    """Return the surface of an avatar in a frame; None, with a warning, if the field has none."""
    pose, translation, transforms = (
        torch.as_tensor(values[index]) for values in (sequence.poses, sequence.translation, sequence.bone_transforms)
    )
    try:
        return field_surface(avatar, pose, translation, resolution, transforms=transforms)
    except ValueError as error:
        log.warning("warning: no surface for %s, frame %d: %s", sequence.name, sequence.frame_numbers[index], error)
        return None
