"""`snarf train` end to end on a bending capsule: the run folder, resuming, and protection of existing runs."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_training import avatar_config, toy_store, training_config

from snarfcli import versions
from snarfcli.avatar import Avatar
from snarfcli.commands import train as commands
from snarfcli.commands.train import TrainConfig, run
from snarfcli.datasets.settings import DataConfig
from snarfcli.errors import UserError
from snarfcli.fitting import PoseRefiner
from snarfcli.native import backend
from snarfcli.runs import run_folder
from snarfcli.samples.store import SampleStore
from snarfcli.training.trainer import Trainer

FILES = {"avatar.pt", "checkpoint.pt", "config.yaml", "metrics.json", "tensorboard"}


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> SampleStore:
    return toy_store(tmp_path_factory.mktemp("data"), points=400, frames=12)


@pytest.fixture
def config(store: SampleStore, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> TrainConfig:
    caplog.set_level(logging.INFO, "snarfcli")
    parts = avatar_config()
    return TrainConfig(
        subject="toy",
        data=DataConfig("builtin", 1, 1, 1),
        model=parts.model,
        skinning=parts.skinning,
        search=parts.search,
        shape=parts.shape,
        condition=parts.condition,
        training=training_config(steps=6, validate_every=3, checkpoint_every=4, bootstrap_steps=3),
        data_root=str(store.folder.parents[2]),
        output_root=str(tmp_path / "outputs"),
        run="mine",
        resume=False,
        overwrite=False,
        device="cpu",
        threads=None,
        seed=0,
    )


def folder_of(config: TrainConfig) -> Path:
    return Path(config.output_root) / "builtin" / "toy" / config.run


def test_the_run_folder_holds_all_that_a_run_should(config, caplog):
    run(config)
    folder = folder_of(config)
    assert {path.name for path in folder.iterdir()} == FILES
    assert any((folder / "tensorboard").iterdir())
    metrics = json.loads((folder / "metrics.json").read_text())
    assert {name: metrics[name] for name in ("data", "subject", "model", "split", "steps", "seed")} == {
        "data": "builtin", "subject": "toy", "model": "fast_snarf", "split": "validation", "steps": 6, "seed": 0,
    }  # fmt: skip
    assert 0 <= metrics["iou_surface"] <= 1
    assert metrics["timings"]["points_per_second"] > 0
    assert metrics["timings"]["processor_s"] > 0
    assert len(metrics["code"]["digest"]) == 12
    assert metrics["earlier_code"] == []
    assert {"versions", "machine"} <= set(metrics)
    assert "steps: 6" in (folder / "config.yaml").read_text()
    assert Avatar.load(folder / "avatar.pt").facts["steps"] == 6
    assert "data: builtin, subject toy, 1 sequence, 11 frames to train on" in caplog.text
    assert "points/s" in caplog.text
    assert "validation (held-back motion): IoU bbox" in caplog.text


def test_the_version_of_the_code_is_that_of_the_beginning(config, monkeypatch):
    digest = ["before"]
    monkeypatch.setattr(versions, "_digest", lambda package: digest[0])
    versions.recorded_code.cache_clear()
    work = commands.train

    def later(*given, **named):
        digest[0] = "after"
        return work(*given, **named)

    monkeypatch.setattr(commands, "train", later)
    run(config)
    versions.recorded_code.cache_clear()
    assert json.loads((folder_of(config) / "metrics.json").read_text())["code"]["digest"] == "before"


def test_an_interrupted_run_resumes_to_the_same_avatar(config, monkeypatch, caplog):
    whole = replace(config, run="whole")
    run(whole)
    advance = Trainer.advance

    def interrupted(self):
        numbers = advance(self)
        if self.step == 5:
            raise KeyboardInterrupt
        return numbers

    monkeypatch.setattr(Trainer, "advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(config)
    assert "continue with resume=true" in caplog.text
    assert {path.name for path in folder_of(config).iterdir()} == FILES - {"avatar.pt", "metrics.json"}
    monkeypatch.setattr(Trainer, "advance", advance)
    with pytest.raises(UserError, match="already has a run; give resume=true to continue it, overwrite=true"):
        run(config)
    torch.manual_seed(99)
    run(replace(config, resume=True))
    assert "resuming at step 4 of 6" in caplog.text
    mine, theirs = (Avatar.load(folder_of(c) / "avatar.pt").model.state_dict() for c in (config, whole))
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs)

    before = (folder_of(config) / "avatar.pt").read_bytes()
    run(replace(config, resume=True))
    assert "already trained" in caplog.text
    assert (folder_of(config) / "avatar.pt").read_bytes() == before
    with pytest.raises(UserError, match=r"made with other settings \(seed: 0 there, 1 here\)"):
        run(replace(config, resume=True, seed=1))
    run(replace(config, overwrite=True, seed=1))
    assert (folder_of(config) / "avatar.pt").read_bytes() != before


def test_a_backend_that_is_not_there_is_refused_before_anything_is_written(config, monkeypatch):
    monkeypatch.setattr(backend, "why_no_kernels", lambda device: "it was not built")
    chosen = replace(config, search=replace(config.search, backend="native"))
    with pytest.raises(UserError, match=r"^backend native is not available: it was not built; "):
        run(chosen)
    assert not folder_of(chosen).exists()


def test_an_interrupt_while_poses_are_finished_loses_nothing(config, monkeypatch):
    monkeypatch.setattr("snarfcli.training.trainer._REFINE_FROM", 2)
    config = replace(config, training=replace(config.training, refine_poses=True))
    finish = PoseRefiner.finish

    def interrupted(self, avatar):
        raise KeyboardInterrupt

    monkeypatch.setattr(PoseRefiner, "finish", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(config)
    assert {path.name for path in folder_of(config).iterdir()} == FILES - {"metrics.json"}
    monkeypatch.setattr(PoseRefiner, "finish", finish)
    run(replace(config, resume=True))
    assert {path.name for path in folder_of(config).iterdir()} == FILES | {"refined_poses.npz"}
    metrics = json.loads((folder_of(config) / "metrics.json").read_text())
    assert metrics["refined_poses"]["frames"] > 0
    before = (folder_of(config) / "refined_poses.npz").read_bytes()
    run(replace(config, resume=True))
    assert (folder_of(config) / "refined_poses.npz").read_bytes() == before
    run(replace(config, run="whole"))
    poses = [np.load(folder_of(replace(config, run=name)) / "refined_poses.npz")["poses"] for name in ("mine", "whole")]
    np.testing.assert_array_equal(*poses)


def test_a_damaged_checkpoint_is_named_and_left(config):
    folder_of(config).mkdir(parents=True)
    path = folder_of(config) / "checkpoint.pt"
    path.write_bytes(b"half of a checkpoint")
    with pytest.raises(UserError, match=r"checkpoint.*is not a file of PyTorch, or is cut off"):
        run(replace(config, resume=True))
    assert [file.name for file in folder_of(config).iterdir()] == ["checkpoint.pt"]


@pytest.mark.parametrize(
    ("group", "changes", "message"),
    [
        ("model", {"name": "slow_snarf"}, "model.name: wanted fast_snarf, .* did you mean 'fast_snarf'"),
        ("model", {"blend": "mean"}, "model.blend.* logit or probability, got 'mean'"),
        ("shape", {"activation": "tanh"}, "shape.activation"),
        ("shape", {"depth": 0}, "shape.depth: wanted at least 1, got 0"),
        ("training", {"poses_per_step": 0}, "training.poses_per_step: wanted at least 1"),
        ("training", {"uniform_points": 0, "surface_points": 0}, "wanted at least one point, got 0 and 0"),
        ("training", {"joint_target": "own_"}, "training.joint_target: wanted halves, parent or own, .* did you mean 'own'"),
        ("training", {"learning_rate": float("nan")}, "training.learning_rate: wanted "),
    ],
)
def test_settings_that_cannot_be_used_make_nothing(config, group, changes, message):
    with pytest.raises(UserError, match=message):
        run(replace(config, **{group: replace(getattr(config, group), **changes)}))
    assert not Path(config.output_root).exists()


def test_a_run_folder_that_is_a_link_can_be_replaced(config, tmp_path):
    place = run_folder(config.output_root, config.data.name, config.subject, config.run)
    place.parent.mkdir(parents=True)
    (tmp_path / "elsewhere" / "old").mkdir(parents=True)
    (tmp_path / "elsewhere" / "checkpoint.pt").touch()
    place.symlink_to(tmp_path / "elsewhere")
    config.overwrite = True
    run(config)
    assert place.is_symlink()
    assert (tmp_path / "elsewhere" / "avatar.pt").is_file()
    assert not (tmp_path / "elsewhere" / "old").exists()
