"""`snarf eval` end to end: a bending capsule, and an untrained avatar whose prior is a capsule around its bone."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_training import avatar_config, new_avatar, toy_store

from snarfcli import versions
from snarfcli.avatar import Avatar
from snarfcli.commands import evaluate as commands
from snarfcli.commands.evaluate import EvalConfig, run
from snarfcli.commands.search_names import search_name
from snarfcli.datasets.settings import DataConfig
from snarfcli.deformer import SearchConfig
from snarfcli.errors import UserError
from snarfcli.evaluation import evaluate as module
from snarfcli.samples.store import SampleStore


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> SampleStore:
    """Processed samples of the toy: 3 held-out frames and 2 out of distribution."""
    return toy_store(tmp_path_factory.mktemp("data"), points=800, frames=4)


def toy_avatar(store: SampleStore, subject: str = "toy") -> Avatar:
    """Return an untrained avatar: the capsule prior fills its one bone, and the other half of the body is missing."""
    torch.manual_seed(0)
    avatar = new_avatar(store, avatar_config(capsules=True))
    avatar.facts = {"data": "builtin", "subject": subject, "steps": 0, "loss": float("nan")}
    return avatar


@pytest.fixture
def config(store: SampleStore, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> EvalConfig:
    """Settings that evaluate the toy avatar in its run folder."""
    caplog.set_level(logging.INFO, "snarfcli")
    output_root = tmp_path / "outputs"
    toy_avatar(store).save(output_root / "builtin" / "toy" / "fast_snarf" / "avatar.pt")
    return EvalConfig(
        subject="toy",
        data=DataConfig("builtin", 1, 1, 1),
        data_root=str(store.folder.parents[2]),
        output_root=str(output_root),
        run="fast_snarf",
        split="id",
        ckpt=None,
        max_frames=None,
        points=None,
        figure=False,
        refine_poses=False,
        surface_frames=0,
        surface_resolution=32,
        figure_frames=1,
        figure_resolution=24,
        device="cpu",
        threads=None,
        seed=0,
    )


def folder_of(config: EvalConfig) -> Path:
    """Return the run folder."""
    return Path(config.output_root) / "builtin" / "toy" / "fast_snarf"


def read(path: Path) -> dict:
    """Return a metrics file."""
    return json.loads((path / "metrics.json").read_text())


def test_the_numbers_are_those_of_the_avatar_on_the_samples(config, store):
    run(config)
    metrics = read(folder_of(config) / "eval_id")
    (sequence,) = store.sequences("test")
    avatar = Avatar.load(folder_of(config) / "avatar.pt")
    wanted = []
    for frame in range(sequence.num_frames):
        pose, translation = torch.tensor(sequence.poses[[frame]]), torch.tensor(sequence.translation[[frame]])
        inside = avatar.occupancy(torch.tensor(sequence.points(frame))[None], pose, translation)[0].numpy() > 0.5
        truth = sequence.occupancies(frame)
        halves = (slice(0, 400), slice(400, 800))
        wanted.append([(inside & truth)[half].sum() / (inside | truth)[half].sum() for half in halves])
    assert metrics["iou_bbox"] == pytest.approx(np.mean(wanted, 0)[0], abs=1e-6)
    assert metrics["iou_surface"] == pytest.approx(np.mean(wanted, 0)[1], abs=1e-6)
    assert 0.2 < metrics["iou_bbox"] < 0.8  # one of two bones


def test_metrics_say_what_was_measured(config):
    run(config)
    metrics = read(folder_of(config) / "eval_id")
    assert {name: metrics[name] for name in ("data", "subject", "model", "split", "frames", "seed")} == {
        "data": "builtin", "subject": "toy", "model": "fast_snarf", "split": "id", "frames": 3, "seed": 0,
    }  # fmt: skip
    assert list(metrics["sequences"]) == ["wave"]
    assert metrics["sequences"]["wave"]["per_frame"]["frame"] == [0, 1, 2]
    assert metrics["search"]["name"] == "complete"
    assert metrics["training"] == {"data": "builtin", "subject": "toy", "steps": 0, "loss": None}
    assert metrics["settings"]["points"] is None
    assert metrics["samples"]["points_per_frame"] == 800
    assert metrics["timings"]["points"] == 2400
    assert metrics["timings"]["total_s"] > 0
    assert {"snarf", "torch", "python"} <= set(metrics["versions"])
    assert [path.name for path in (folder_of(config) / "eval_id").iterdir()] == ["metrics.json"]


def test_the_version_of_the_code_is_that_of_the_beginning(config, monkeypatch):
    digest = ["before"]
    monkeypatch.setattr(versions, "_digest", lambda package: digest[0])
    versions.recorded_code.cache_clear()
    work = commands.evaluate

    def later(*given, **named):
        digest[0] = "after"
        return work(*given, **named)

    monkeypatch.setattr(commands, "evaluate", later)
    run(config)
    versions.recorded_code.cache_clear()
    assert read(folder_of(config) / "eval_id")["code"]["digest"] == "before"


def test_out_of_distribution_goes_to_its_own_folder(config, caplog):
    run(replace(config, split="ood", points=100, max_frames=1))
    metrics = read(folder_of(config) / "eval_ood_part")
    assert (metrics["split"], metrics["frames"], metrics["points_per_frame"]) == ("ood", 1, 100)
    assert list(metrics["sequences"]) == ["fold"]
    assert "out of distribution (ood)" in caplog.text
    assert "time for 200,000 points" in caplog.text
    assert str(folder_of(config) / "eval_ood_part" / "metrics.json") in caplog.text


def test_another_search_leaves_the_avatars_own_results(config):
    run(config)
    search = SearchConfig(name="broyden", init_bones=[0, 1], tolerance=5e-5)
    run(replace(config, search=search))
    assert read(folder_of(config) / "eval_id")["search"]["name"] == "complete"
    broyden = read(folder_of(config) / f"eval_id_{search_name(search)}")
    assert broyden["search"]["init_bones"] == [0, 1]
    assert broyden["settings"]["search"]["name"] == "broyden"


def test_results_go_beside_a_given_checkpoint(config, store, tmp_path, caplog):
    toy_avatar(store, subject="other").save(tmp_path / "elsewhere" / "mine.pt")
    run(replace(config, ckpt=str(tmp_path / "elsewhere" / "mine.pt")))
    assert (
        read(tmp_path / "elsewhere" / "eval_id_toy")["frames"] == 3
    )  # the results of the avatar's own subject have another folder
    assert not (folder_of(config) / "eval_id").exists()
    assert "trained on subject other and is evaluated on subject toy" in caplog.text


def test_no_avatar_names_the_command_that_makes_one(config):
    (folder_of(config) / "avatar.pt").unlink()
    with pytest.raises(
        UserError, match=r'no avatar in .*fast_snarf; run "snarf train subject=toy output_root=.*" or give ckpt=PATH'
    ):
        run(config)


def test_no_samples_name_the_command_that_makes_them(config, tmp_path):
    avatar = str(folder_of(config) / "avatar.pt")
    with pytest.raises(UserError, match=r"no samples of subject 50002 .*snarf preprocess"):
        run(replace(config, data_root=str(tmp_path / "nothing"), subject="50002", ckpt=avatar))


def test_an_unknown_subject_is_named_with_the_nearest_one(config):
    with pytest.raises(UserError, match="no built-in subject '50003'; did you mean '500"):
        run(replace(config, subject="50003"))


def test_an_avatar_of_another_skeleton_is_rejected(config, store):
    skeleton = store.skeleton
    joints = torch.cat([skeleton.joints_rest, torch.tensor([[1.0, 0, 0]])])
    longer = replace(
        skeleton,
        names=("root", "middle", "tip"),
        parents=(-1, 0, 1),
        joints_rest=joints,
        canonical_pose=torch.zeros(3, 3),
    )
    Avatar(avatar_config(capsules=True), longer, toy_avatar(store).model.deformer.grid).save(folder_of(config) / "avatar.pt")
    with pytest.raises(
        UserError, match=r"wanted samples of the avatar's skeleton .3 joints., got another with 2 .subject toy."
    ):
        run(config)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"split": "odd"}, "split: wanted id or ood, got 'odd'; did you mean 'ood'"),
        ({"max_frames": 0}, "max_frames: wanted at least 1, got 0"),
        ({"points": 1}, "points: wanted at least 2, got 1"),
        ({"figure_resolution": 4}, "figure_resolution: wanted at least 16"),
        ({"search": SearchConfig(name="broiden")}, "search.name: wanted .* did you mean 'broyden'"),
        ({"search": SearchConfig(name="broyden", init_bones=[7])}, r"search.init_bones: wanted bones from 0 to 1, got \[7\]"),
        ({"seed": -1}, "seed: wanted at least 0"),
        ({"precision": "hihg"}, "precision: wanted highest, high, medium or bfloat16, got 'hihg'; did you mean 'high'"),
        ({"search": SearchConfig(jacobian="broiden")}, "search.jacobian: wanted exact or broyden, .* did you mean 'broyden'"),
        ({"search": SearchConfig(jacobian="broyden")}, "search.jacobian=broyden is for search=broyden"),
        ({"search": SearchConfig(tolerance=0.0)}, "search.tolerance: wanted a positive number"),
        ({"search": SearchConfig(name="complete", init_bones=[0])}, "search.init_bones is for search=broyden"),
    ],
)
def test_wrong_settings_are_named(config, changes, message):
    with pytest.raises(UserError, match=message):
        run(replace(config, **changes))
    assert not list(folder_of(config).glob("eval*"))


def test_an_interrupted_run_leaves_the_results_as_they_were(config, monkeypatch):
    run(config)
    before = (folder_of(config) / "eval_id" / "metrics.json").read_bytes()
    calls = []

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return measure(*arguments)

    measure = module.measure_frame
    monkeypatch.setattr(module, "measure_frame", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(config)
    assert [path.name for path in (folder_of(config) / "eval_id").iterdir()] == ["metrics.json"]
    assert (folder_of(config) / "eval_id" / "metrics.json").read_bytes() == before


def test_a_folder_that_cannot_be_written_is_found_before_the_work(config, tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(UserError, match=r"cannot write results to .*eval_id"):
        run(config)


def test_the_figure_shows_worst_and_best_frames(config, caplog):
    from PIL import Image

    run(replace(config, figure=True))
    picture = np.asarray(Image.open(folder_of(config) / "eval_id" / "frames.png"))
    assert picture.shape[1] > picture.shape[0] > 320  # one row of six pictures
    assert str(folder_of(config) / "eval_id" / "frames.png") in caplog.text
    # a figure of older numbers is deleted
    run(replace(config, figure=False))
    assert not (folder_of(config) / "eval_id" / "frames.png").exists()


def test_an_avatar_without_any_surface_is_evaluated_and_drawn(config, store, caplog):
    avatar = toy_avatar(store)
    avatar.model.shape.bones += 50.0  # the prior, and with it the body, is far outside the grid
    avatar.save(folder_of(config) / "avatar.pt")
    run(replace(config, figure=True))
    metrics = read(folder_of(config) / "eval_id")
    assert (metrics["iou_bbox"], metrics["iou_surface"]) == (0.0, 0.0)
    assert (folder_of(config) / "eval_id" / "frames.png").exists()
    assert "nothing to draw for wave, frame" in caplog.text


def test_the_yaml_fits_the_settings():
    from hydra import compose, initialize_config_dir
    from hydra.core.config_store import ConfigStore
    from omegaconf import OmegaConf

    from snarfcli.hydra_config.schema import config_folder

    for name, schema in (("eval", EvalConfig), ("data", DataConfig), ("search", SearchConfig)):
        ConfigStore.instance().store(group="schema", name=name, node=schema)
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        plain = OmegaConf.to_object(compose("eval"))
        other = OmegaConf.to_object(compose("eval", ["search=broyden", "search.init_bones=[0,1]", "split=ood"]))
    assert isinstance(plain, EvalConfig)
    assert (plain.search, plain.run, plain.split, plain.data.name) == (None, "fast_snarf", "id", "builtin")
    assert (other.search.name, other.search.init_bones, other.split) == ("broyden", [0, 1], "ood")


def test_surfaces_are_compared(config, store, caplog):
    run(replace(config, surface_frames=2, surface_resolution=48))
    surfaces = read(folder_of(config) / "eval_id")["surfaces"]
    assert surfaces["frames"] == 2
    assert surfaces["frames_without_surface"] == 0
    assert surfaces["resolution"] == 48
    # half of the capsule is missing, and the other half is 3 cm too thin
    assert 0.03 < surfaces["chamfer_m"] < 0.3
    assert surfaces["f_score"] == 0
    assert 0.5 < surfaces["normal_consistency"] < 1
    assert "surfaces of 2 frames at resolution 48: Chamfer distance" in caplog.text
    run(config)
    assert read(folder_of(config) / "eval_id")["surfaces"] is None
    with pytest.raises(UserError, match="surface_frames: wanted at least 0, got -1"):
        run(replace(config, surface_frames=-1))


def test_values_that_are_nan_end_the_evaluation(config, monkeypatch):
    def broken(self, found, pose):
        values = shape_at(self, found, pose)
        values.logits[..., 3] = torch.nan
        return values

    shape_at = Avatar.shape_at
    monkeypatch.setattr(Avatar, "shape_at", broken)
    with pytest.raises(UserError, match=r"frame \d+: the avatar's occupancy is NaN at 1 of \d+ points; train it again"):
        run(config)
    assert not (folder_of(config) / "eval_id").exists()


def test_results_that_are_nan_are_not_written(config, monkeypatch):
    monkeypatch.setattr(commands, "measure_weights", lambda *_: {"wrong_share": float("nan"), "vertices": 3})
    monkeypatch.setattr(commands, "weights_text", str)
    with pytest.raises(UserError, match=r"weights\.wrong_share is nan, so nothing was written"):
        run(config)
    assert not (folder_of(config) / "eval_id").exists()
