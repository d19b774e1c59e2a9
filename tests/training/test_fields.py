"""`snarf train` with each weight field on the bending capsule, from settings to a usable avatar."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_subject import toy_body
from toy_training import avatar_config, toy_store, training_config

from snarfcli.avatar import Avatar
from snarfcli.commands.evaluate import EvalConfig
from snarfcli.commands.evaluate import run as evaluate
from snarfcli.commands.train import TrainConfig, new_trainer, run
from snarfcli.datasets.settings import DataConfig
from snarfcli.deformer import SearchConfig
from snarfcli.errors import UserError

FIELDS = ["distilled", "voxel", "mlp", "preset"]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return toy_store(tmp_path_factory.mktemp("data"), points=400, frames=12)


@pytest.fixture
def config_for(store, tmp_path, caplog):
    """Return a function that makes the settings of a run with one field."""
    caplog.set_level(logging.INFO, "snarfcli")

    def make(name: str, softmax: str = "plain", **training) -> TrainConfig:
        parts = avatar_config(capsules=True, max_steps=20)
        skinning = replace(parts.skinning, name=name, softmax=softmax)
        search = parts.search
        if name == "voxel":
            skinning.smoothness = 0.001
        if name == "mlp":
            search = SearchConfig("broyden", max_steps=20)
        if name == "preset":
            skinning.weights_file = str(tmp_path / "weights.npz")
            body = toy_body()
            np.savez(skinning.weights_file, vertices=store.template.vertices, weights=body.weights.numpy())
        steps = {"steps": 6, "refresh_cells_every": 2, "validate_every": 6, "checkpoint_every": 4, "bootstrap_steps": 3}
        return TrainConfig(
            subject="toy", data=DataConfig("builtin", 1, 1, 1), model=parts.model, skinning=skinning, search=search,
            shape=parts.shape, condition=parts.condition, training=training_config(**(steps | training)),
            data_root=str(store.folder.parents[2]), output_root=str(tmp_path / "outputs"), run=name,
            resume=False, overwrite=False, device="cpu", threads=None, seed=0,
        )  # fmt: skip

    return make


def eval_config(config: TrainConfig, search: SearchConfig | None = None) -> EvalConfig:
    return EvalConfig(
        subject="toy", data=config.data, search=search, data_root=config.data_root, output_root=config.output_root,
        run=config.run, split="id", ckpt=None, max_frames=2, points=None, figure=False, figure_frames=1,
        refine_poses=False, surface_frames=0, surface_resolution=32, figure_resolution=24, device="cpu", threads=None, seed=0,
    )  # fmt: skip


@pytest.mark.parametrize("softmax", ["plain", "hierarchical"])
@pytest.mark.parametrize("name", FIELDS)
def test_trains_saves_evaluates_and_poses(config_for, name, softmax):
    config = config_for(name, softmax)
    run(config)
    if name == "preset":
        Path(config.skinning.weights_file).unlink()  # the avatar is whole without it
    avatar = Avatar.load(Path(config.output_root) / "builtin" / "toy" / name)
    evaluate(eval_config(config))
    points = torch.tensor([[0.0, 0.02, 0.01], [0.2, 0.0, 0.0], [0.45, 0.03, 0.0]])
    weights = avatar.skinning_weights(points)
    torch.testing.assert_close(weights.sum(1), torch.ones(3))
    pose = torch.tensor([[0.0, 0.0, 0.3], [0.0, 0.0, 0.5]])
    transforms = avatar.bone_transforms(pose[None])
    posed = avatar.skin(points, transforms[0])
    with torch.no_grad():
        found = avatar.model.deformer(posed[None], transforms)
    for query, point in enumerate(points):
        assert float((found.canonical[found.query == query] - point).norm(dim=1).min()) < 1e-3
    box_c = avatar.canonical_box()
    anywhere = box_c[0] + torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)) * (box_c[1] - box_c[0])
    inside = anywhere[avatar.canonical_logits(anywhere, avatar.skeleton.canonical_pose) > 0]
    posed, (lower, upper) = avatar.skin(inside, transforms[0]), avatar.posed_box(transforms[0])
    assert len(inside)
    assert bool((posed >= lower).all())
    assert bool((posed <= upper).all())
    for surface in ("field", "skinned"):
        assert len(avatar.mesh(pose, resolution=24, surface=surface).faces) > 20


def test_preset_weights_do_not_change_and_the_others_do(config_for, store):
    for name in FIELDS:
        config = config_for(name)
        trainer = new_trainer(config, store, torch.device("cpu"))
        before = {key: value.clone() for key, value in trainer.model.deformer.field.state_dict().items()}
        numbers = trainer.advance()
        after = trainer.model.deformer.field.state_dict()
        assert all(torch.equal(before[key], after[key]) for key in before) == (name == "preset")
        assert ("smoothness" in numbers) == (name == "voxel")
        assert ("joint_weight" in numbers) == (name != "preset")


def test_hierarchical_weights_learn_the_joint_target(config_for, store):
    config = config_for("voxel", "hierarchical", steps=40, bootstrap_steps=40, joint_target="own", joint_weight=10.0)
    trainer = new_trainer(config, store, torch.device("cpu"))
    for _ in range(40):
        trainer.advance()
    weights = trainer.model.deformer.field(trainer.objective.joints)
    torch.testing.assert_close(weights.detach(), torch.eye(2), atol=0.15, rtol=0)


def test_cells_follow_the_learned_shape(config_for, store):
    config = config_for("distilled", steps=60, bone_occupancy_weight=1.0)
    config.skinning.resolution = [32, 16, 16]
    config.shape = avatar_config(capsules=True).shape
    trainer = new_trainer(config, store, torch.device("cpu"))
    first = int(trainer.model.deformer.active_cells.sum())
    for _ in range(30):
        trainer.advance()
    later = int(trainer.model.deformer.active_cells.sum())
    final = trainer.finished_avatar().model.deformer.active_cells
    assert int(final.sum()) <= later <= first
    assert not bool((final & ~trainer.model.deformer.active_cells).any())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "mesh"}, "skinning.name: wanted distilled, voxel, mlp or preset, got 'mesh'"),
        ({"softmax": "flat"}, "skinning.softmax: wanted plain or hierarchical, got 'flat'"),
        ({"name": "mlp"}, "search: wanted snarf or broyden with skinning=mlp, got complete"),
        ({"name": "preset"}, "skinning=preset needs skinning.weights_file=FILE"),
        ({"name": "preset", "weights_file": "nowhere.npz"}, "no weights file at nowhere.npz"),
        ({"weights_file": "some.npz"}, "skinning.weights_file is for skinning=preset"),
        ({"smoothness": 0.1}, "skinning.smoothness is for skinning=voxel"),
        ({"name": "voxel", "smoothness": -1.0}, "skinning.smoothness: wanted at least 0, got -1.0"),
        ({"prior_falloff_m": 0.0}, "skinning.prior_falloff_m: wanted a positive number"),
        ({"resolution": [8, 8]}, "skinning.resolution: wanted three numbers"),
    ],
)
def test_settings_that_do_not_fit_make_nothing(config_for, changes, message):
    config = config_for("distilled")
    config.skinning = replace(config.skinning, **changes)
    with pytest.raises(UserError, match=message):
        run(config)
    assert not Path(config.output_root).exists()


def test_a_field_without_cells_is_not_evaluated_cell_by_cell(config_for):
    config = config_for("mlp")
    run(config)
    with pytest.raises(
        UserError, match=r"search.name: wanted broyden for skinning.name 'mlp', got 'complete'.*; leave search out"
    ):
        evaluate(eval_config(config, SearchConfig("complete")))
