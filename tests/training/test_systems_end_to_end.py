"""`snarf train`, `eval` and `animate` with every system on the bending capsule; trainings that end early."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_training import avatar_config, toy_store, training_config

from snarfcli.avatar import Avatar
from snarfcli.commands import animate
from snarfcli.commands.evaluate import EvalConfig
from snarfcli.commands.evaluate import run as evaluate
from snarfcli.commands.train import TrainConfig, run
from snarfcli.datasets.settings import DataConfig
from snarfcli.deformer import SearchConfig
from snarfcli.errors import UserError
from snarfcli.models.checkpoint import load_checkpoint
from snarfcli.models.settings import ModelConfig
from snarfcli.models.trained_field import SYSTEMS
from snarfcli.samples.store import SampleStore
from snarfcli.shape import ConditionConfig
from snarfcli.training import objective as objective_module
from snarfcli.training.trainer import CHECKPOINT_FORMAT, CHECKPOINT_VERSION, Diverged


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return toy_store(tmp_path_factory.mktemp("data"), points=400, frames=12)


@pytest.fixture
def config_for(store, tmp_path):
    """Return a function that makes the settings of a run with one system."""

    def make(name: str, **training) -> TrainConfig:
        parts = avatar_config(capsules=True)
        search = SearchConfig("broyden", max_steps=20) if name == "snarf" else parts.search
        steps = {"steps": 6, "refresh_cells_every": 2, "validate_every": 6, "checkpoint_every": 4, "bootstrap_steps": 3}
        return TrainConfig(
            subject="toy", data=DataConfig("builtin", 1, 1, 1), model=ModelConfig(name), skinning=parts.skinning,
            search=search, shape=parts.shape, condition=parts.condition, training=training_config(**(steps | training)),
            data_root=str(store.folder.parents[2]), output_root=str(tmp_path / "outputs"), run=name,
            resume=False, overwrite=False, device="cpu", threads=None, seed=0,
        )  # fmt: skip

    return make


def eval_config(config: TrainConfig, **changes) -> EvalConfig:
    settings = EvalConfig(
        subject="toy", data=config.data, search=None, data_root=config.data_root, output_root=config.output_root,
        run=config.run, split="ood", ckpt=None, max_frames=2, points=None, figure=True, figure_frames=1, refine_poses=False,
        surface_frames=1, surface_resolution=24, figure_resolution=24, device="cpu", threads=None, seed=0,
    )  # fmt: skip
    return replace(settings, **changes)


def animate_config(config: TrainConfig, pose: Path, **changes) -> animate.AnimateConfig:
    settings = animate.AnimateConfig(
        subject="toy", data=config.data, data_root=config.data_root, output_root=config.output_root, run=config.run,
        ckpt=None, pose=str(pose), up="y", hands="rest", rest="auto", mapping=None, clip=None, motion=None, motion_seed=0,
        motion_frame_rate=30.0, start=0, stop=None, step=1, frame_rate=None, max_frames=None, in_place=False,
        surface="field", resolution=24, keep_share=0.01, meshes=True, format="ply", weight_colors=False, video=False,
        video_size="64", views=["front"], azimuth_deg=0.0, elevation_deg=0.0, camera="still", turntable="false", beside=[],
        processes="1", output=None, overwrite=False, device="cpu", threads=None,
    )  # fmt: skip
    return replace(settings, **changes)


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_trains_evaluates_and_moves(config_for, name, tmp_path):
    config = config_for(name, learning_rate=1e-3)
    run(config)
    folder = Path(config.output_root) / "builtin" / "toy" / name
    assert json.loads((folder / "metrics.json").read_text())["status"] == "trained"
    evaluate(eval_config(config))
    metrics = json.loads((folder / "eval_ood_part" / "metrics.json").read_text())
    assert metrics["model"] == name
    assert 0 <= metrics["iou_bbox"] <= 1
    np.savez(tmp_path / "pose.npz", poses=np.zeros((2, 2, 3)))
    code = animate.run(animate_config(config, tmp_path / "pose.npz"))
    meshes = list((folder / "animation" / "pose").glob("*.ply"))
    assert len(meshes) == (2 if code == 0 else len(meshes))  # a field without a surface is reported by the exit code
    assert code == 0 or name in ("pose_onet", "nasa", "piecewise")  # whose fields start from nothing
    avatar = Avatar.load(folder)
    if not avatar.has_skinning_weights:
        for wish in ({"surface": "skinned"}, {"weight_colors": True}):
            with pytest.raises(UserError, match=f"needs skinning weights of canonical points, which model {name}"):
                animate.run(animate_config(config, tmp_path / "pose.npz", overwrite=True, **wish))
        with pytest.raises(UserError, match=f"model {name} searches no correspondences"):
            evaluate(eval_config(config, search=SearchConfig("broyden")))


@pytest.mark.parametrize("name", [name for name, system in SYSTEMS.items() if system.needs_template])
def test_systems_that_need_true_weights_reject_samples_without(config_for, name, monkeypatch):
    opened = SampleStore.open

    def without_template(*arguments):
        store = opened(*arguments)
        store.template = None
        return store

    monkeypatch.setattr(SampleStore, "open", without_template)
    config = config_for(name)
    with pytest.raises(UserError, match=f"model={name} needs a mesh with ground-truth skinning weights"):
        run(config)
    assert not Path(config.output_root).exists()


def test_preset_weights_are_for_fast_snarf(config_for):
    config = config_for("back_lbs")
    skinning = replace(config.skinning, name="preset", weights_file="weights.npz")
    with pytest.raises(UserError, match="skinning=preset is for model=fast_snarf, got model=back_lbs; leave skinning out"):
        run(replace(config, skinning=skinning))
    assert not Path(config.output_root).exists()


def test_settings_of_a_system_that_cannot_be_used_are_rejected(config_for):
    config = config_for("snarf")
    with pytest.raises(UserError, match="search: wanted snarf or broyden with model=snarf, got complete"):
        run(replace(config, search=SearchConfig("complete")))
    for name, value in (("part_points", 0), ("part_width", 0), ("part_code", -1), ("part_weight", math.nan)):
        with pytest.raises(UserError, match=f"model.{name}: wanted at least"):
            run(replace(config, model=ModelConfig("nasa", **{name: value})))
    config = config_for("fast_snarf")
    for condition in (ConditionConfig("local", layer=config.shape.depth), ConditionConfig("global", layer=-1)):
        with pytest.raises(UserError, match=f"condition.layer: wanted 0 to {config.shape.depth - 1}"):
            run(replace(config, condition=condition))
    with pytest.raises(UserError, match=r"condition.size: wanted at least 1, got 0"):
        run(replace(config, condition=ConditionConfig("local", size=0)))
    assert not Path(config.output_root).exists()


@pytest.mark.parametrize("what", ["loss", "gradient"])
def test_a_diverged_run_stops_keeps_its_checkpoint_and_says_so(config_for, monkeypatch, what):
    config = config_for("fast_snarf", steps=12)
    calls = []
    true_loss = objective_module.occupancy_loss

    def spoilt(logits, occupied, found):
        calls.append(1)
        loss = true_loss(logits, occupied, found)
        if len(calls) <= 6:
            return loss
        # a square root of zero has a value and no gradient
        return loss * math.nan if what == "loss" else loss + (loss - loss).sqrt()

    monkeypatch.setattr(objective_module, "occupancy_loss", spoilt)
    with pytest.raises(Diverged, match=f"diverged: the {what} is nan at step 6; lower training.learning_rate"):
        run(config)
    folder = Path(config.output_root) / "builtin" / "toy" / "fast_snarf"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert (metrics["status"], metrics["steps"], metrics["checkpoint"]) == ("diverged", 6, True)
    assert not (folder / "avatar.pt").exists()
    state = load_checkpoint(folder / "checkpoint.pt", CHECKPOINT_FORMAT, CHECKPOINT_VERSION, "checkpoint")
    assert state["step"] == 6
    assert all(bool(torch.as_tensor(value).isfinite().all()) for value in state["average"])
