"""Points of a training step besides the stored ones."""

from __future__ import annotations

from dataclasses import replace

import torch
from toy_training import new_avatar, toy_store, training_config

from snarfcli.draws import GeneratorDraws
from snarfcli.training.trainer import Trainer


def test_far_points_are_outside_the_cubes(tmp_path):
    store = toy_store(tmp_path)
    config = training_config(far_points=400)
    trainer = Trainer(new_avatar(store), store, config, 3, torch.device("cpu"))
    batch = trainer.batches.batch(0)
    half = (batch.cube[:, 1] - batch.cube[:, 0]) / 2
    tight = replace(batch, cube=torch.stack([batch.cube[:, 0] + 0.3 * half, batch.cube[:, 1] - 0.3 * half], 1))
    count = batch.points.shape[1]
    for given in (batch, tight):
        more = trainer.objective.with_far_points(given, trainer.model.node_weights(), trainer._draws)
        assert torch.equal(more.points[:, :count], batch.points)
        assert torch.equal(more.occupied[:, :count], batch.occupied)
        far = more.points[:, count:]
        assert far.shape == (config.poses_per_step, 400, 3)
        assert not more.occupied[:, count:].any()
        outside = (far < given.cube[:, None, 0]) | (far > given.cube[:, None, 1])
        assert outside.any(-1).all()
    # those that were moved there by the bones are found again by the search; the others have no candidate
    found = trainer.model.deformer(far, batch.bone_transforms)
    reached = found.found
    assert 0.05 < reached.float().mean() < 0.95
    assert (far[~reached].norm(dim=1) > 5).all()
    assert (far[reached].norm(dim=1) < 3).all()
    again = trainer.objective.with_far_points(tight, trainer.model.node_weights(), trainer._draws)
    assert torch.equal(again.points, more.points)  # a resumed run draws the same


def test_random_canonical_points_fill_the_active_cells(tmp_path):
    deformer = new_avatar(toy_store(tmp_path)).model.deformer
    points = deformer.random_canonical(4000, GeneratorDraws.seeded(0))
    assert deformer.is_active(points).all()
    spread = (points.amax(0) - points.amin(0)) / (deformer.upper - deformer.lower)
    assert (spread > 0.5).all()
