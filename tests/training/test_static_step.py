"""Steps with fixed shapes on batches that are drawn on the device, against the eager step on the same draws."""

from __future__ import annotations

import logging
import math
import weakref
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from toy_training import avatar_config, new_avatar, toy_store, training_config

from snarfcli.commands.train import TrainConfig, new_trainer
from snarfcli.draws import HashedDraws
from snarfcli.hydra_config.schema import config_folder, register_schemas
from snarfcli.models.trained_field import SYSTEMS
from snarfcli.training import objective as objective_module
from snarfcli.training.device_batches import DeviceBatches
from snarfcli.training.graphs import CaptureFailed
from snarfcli.training.loop import train
from snarfcli.training.numbers import StepNumbers
from snarfcli.training.schedule import StepKind, kind_of
from snarfcli.training.trainer import Diverged, Trainer

CPU = torch.device("cpu")
PRESETS = [
    ("paper", []),
    ("paper", ["search=broyden"]),
    ("quick", []),
    ("standard", ["skinning=coarse"]),
    ("stick2d", ["training.agreement_weight=1.0"]),
    *(("quick", [f"model={name}", "condition=none"]) for name in SYSTEMS if name not in ("fast_snarf", "snarf")),
]
SMALL = [
    "training.poses_per_step=3", "training.uniform_points=60", "training.surface_points=60", "training.agreement_points=100",
    "training.graph=on", "skinning.resolution=[20,20,8]",
]  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return toy_store(tmp_path_factory.mktemp("data"), points=400, frames=12)


def grids_config():
    """Return an avatar with feature grids, weights at the nodes, a smoothness loss and a local condition."""
    plain = avatar_config(capsules=True, condition="local")
    shape = replace(plain.shape, name="grid", feature_cells_m=[0.2, 0.08, 0.05], width=24)
    return replace(plain, shape=shape, skinning=replace(plain.skinning, name="voxel", smoothness=1e-3))


def trainer_for(store, architecture=None, device=CPU, **changes) -> Trainer:
    torch.manual_seed(0)
    small = {"poses_per_step": 2, "uniform_points": 60, "surface_points": 60, "agreement_weight": 1.0, "graph": "on"}
    config = training_config(**(small | {"learning_rate": 1e-3, "steps": 100} | changes))
    return Trainer(new_avatar(store, architecture), store, config, 0, device)


def preset_trainer(store, name: str, changes: list[str]) -> Trainer:
    register_schemas("train", TrainConfig)
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = OmegaConf.to_object(compose("train", [f"training={name}", *SMALL, *changes]))
    torch.manual_seed(0)
    return new_trainer(config, store, CPU)


def advance_to(trainer: Trainer, step: int) -> list[float]:
    """Take steps up to a number; return the loss of each."""
    losses = {}
    while trainer.step < step:
        loss = trainer.advance()["total"]
        losses[trainer.step - 1] = loss  # after a halt, that of the step that is taken again
    return list(losses.values())


def eager(trainer: Trainer) -> Trainer:
    """Return a trainer that takes eager steps on the batches of static ones."""
    trainer._ahead = None
    return trainer


def largest_difference(some: Sequence[torch.Tensor], others: Sequence[torch.Tensor], least: float) -> float:
    """Return the largest difference of tensors, each as a share of the largest number in it, or of `least`."""
    pairs = [(mine.detach(), theirs.detach()) for mine, theirs in zip(some, others, strict=True) if mine.numel()]
    return max(float((mine - theirs).abs().max()) / max(float(theirs.abs().max()), least) for mine, theirs in pairs)


# ---------------------------------------------------------------- one step
@pytest.mark.parametrize(("name", "changes"), PRESETS, ids=lambda value: value if isinstance(value, str) else ",".join(value))
def test_loss_and_gradients_are_those_of_the_eager_step(store, name, changes):
    trainer = preset_trainer(store, name, changes)
    batch, draws = trainer.batches.batch(5), partial(HashedDraws, 0, torch.tensor(5))

    def evaluate(capacity):
        trainer.optimizer.zero_gradients()
        evaluated = trainer.objective.evaluate(batch, StepKind(True, True), draws, capacity)
        trainer.objective.add_gradients(evaluated)
        return evaluated, [p.grad for p in trainer.optimizer.parameters if p.grad is not None]

    wanted, gradients = evaluate(None)
    assert len(gradients) > 3
    roots = 0 if wanted.roots is None else int(wanted.roots)
    assert (roots > 0) == (trainer.model.search is not None)
    for capacity in (roots, roots + 100, 4 * roots):
        got, others = evaluate(capacity)
        assert got.losses.keys() == wanted.losses.keys()
        # float32: sums of other lengths, and products of matrices with other numbers of rows, round otherwise
        assert float(got.total.detach()) == pytest.approx(float(wanted.total.detach()), rel=2e-6)
        assert largest_difference(others, gradients, 1e-6) <= 2e-5
        for key, value in wanted.numbers().items():
            assert float(got.numbers()[key].detach()) == pytest.approx(float(value.detach()), rel=1e-5, abs=1e-6)


def test_agreement_counts_the_same_points_masked_or_left_out(store):
    trainer = trainer_for(store, grids_config())
    with torch.no_grad():
        for parameter in trainer.model.shape.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    batch, draws = trainer.batches.batch(0), partial(HashedDraws, 0, torch.tensor(0))
    kind = StepKind(bootstraps=False, agrees=True)
    left_out, masked = (trainer.objective.evaluate(batch, kind, draws, size).losses["agreement"] for size in (None, 2000))
    assert float(left_out.detach()) > 0
    torch.testing.assert_close(masked, left_out, rtol=1e-5, atol=0)


# ---------------------------------------------------------------- many steps
@pytest.mark.parametrize("architecture", [lambda: avatar_config(capsules=True, condition="local"), grids_config])
def test_a_run_follows_the_eager_run(store, architecture):
    """With refreshed cells, growing grids, extended weights, bootstrap and agreement: all that happens between replays."""
    changes = {"refresh_cells_every": 8, "extend_weights_every": 12, "bootstrap_steps": 15}
    one, other = (trainer_for(store, architecture(), **changes) for _ in range(2))
    losses, wanted = advance_to(one, 30), advance_to(eager(other), 30)
    assert losses == pytest.approx(wanted, rel=1e-4)  # rounding grows from step to step
    assert one._ahead is not None
    assert one._ahead._static.progress().step == 30
    assert largest_difference(one.optimizer.average, other.optimizer.average, 1e-3) <= 1e-2
    assert torch.equal(one.model.deformer.active_cells, other.model.deformer.active_cells)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("fresh_points", [False, True])
def test_on_a_gpu_captured_steps_follow_the_eager_run(store, caplog, fresh_points):
    changes = {"refresh_cells_every": 12, "extend_weights_every": 12, "bootstrap_steps": 15, "graph": "auto", "workers": 0}
    changes |= {"fresh_points": fresh_points, "device": torch.device("cuda:0")}
    one, other = (trainer_for(store, grids_config(), **changes) for _ in range(2))
    with caplog.at_level(logging.DEBUG, "snarfcli.training.graphs"):
        losses = advance_to(one, 40)
    assert sum(record.message.startswith("captured a step") for record in caplog.records) >= 4
    assert one._ahead is not None
    assert losses == pytest.approx(advance_to(eager(other), 40), rel=1e-3)  # atomics add in another order in every run


def test_fresh_points_are_staged_for_static_steps(store):
    one, other = (trainer_for(store, fresh_points=True, workers=0) for _ in range(2))
    losses, wanted = advance_to(one, 12), advance_to(eager(other), 12)
    assert losses == pytest.approx(wanted, rel=1e-5)
    assert one._ahead is not None
    assert one._ahead._static.progress().step == 12


def test_a_step_with_too_many_roots_changes_nothing_and_is_taken_later(store):
    one, other = trainer_for(store), eager(trainer_for(store))
    advance_to(one, 5)
    assert one._ahead is not None
    static = one._ahead._static
    enough, static.capacity = static.capacity, 10
    before = [value.clone() for value in one.optimizer.tensors()]
    for _ in range(3):
        one.advance()
    assert one.step == 8  # the host does not know yet
    progress = static.progress()
    assert (progress.step, progress.is_halted, progress.is_cut) == (5, True, True)
    assert 10 < progress.most_roots < enough
    assert all(torch.equal(*pair) for pair in zip(before, one.optimizer.tensors(), strict=True))
    one.settle()
    assert one.step == 6  # the step was taken eagerly
    assert static.capacity >= 1.25 * progress.most_roots
    losses = advance_to(one, 12)
    assert losses == pytest.approx(advance_to(other, 12)[6:], rel=1e-5)


def test_steps_beyond_the_last_can_be_taken(store):
    one, other = (trainer_for(store, steps=6, warmup_steps=9, final_learning_rate=0.1) for _ in range(2))
    assert advance_to(one, 12) == pytest.approx(advance_to(eager(other), 12), rel=1e-5)


def test_no_step_is_lost_where_the_capacity_is_often_too_small(store):
    one, other = trainer_for(store, steps=24), eager(trainer_for(store, steps=24))
    assert one._ahead is not None
    for step in (4, 13, 21):
        advance_to(one, step)
        one._ahead._static.capacity = 10
    advance_to(one, 24)
    advance_to(other, 24)
    assert one.step == other.step == 24
    assert largest_difference(one.optimizer.parameters, other.optimizer.parameters, 1e-3) <= 1e-3


def test_a_failed_capture_leaves_no_memory_to_the_eager_step(store, monkeypatch):
    trainer = trainer_for(store)
    advance_to(trainer, 5)
    left = []

    def fail(step: int, kind: StepKind) -> None:
        of_the_step = torch.zeros(3)
        left.append(weakref.ref(of_the_step))
        try:
            raise torch.OutOfMemoryError("CUDA out of memory")
        except torch.OutOfMemoryError as error:
            raise CaptureFailed("there is not enough memory on the GPU") from error

    def take() -> StepNumbers:
        assert [one() for one in left] == [None]
        return true_step()

    true_step = trainer._eager_step
    monkeypatch.setattr(trainer._ahead, "run", fail)
    monkeypatch.setattr(trainer, "_eager_step", take)
    trainer.advance()
    assert trainer.step == 6
    assert trainer._ahead is None


@pytest.mark.parametrize("what", ["loss", "gradient"])
def test_a_step_that_is_not_finite_changes_nothing_and_is_told(store, monkeypatch, what):
    trainer = trainer_for(store)
    advance_to(trainer, 6)
    before = [value.clone() for value in trainer.optimizer.tensors()]
    true_loss = objective_module.occupancy_loss

    def spoilt(logits, occupied, found):
        loss = true_loss(logits, occupied, found)
        return loss * math.nan if what == "loss" else loss + (loss - loss).sqrt()  # which has a value and no gradient

    with monkeypatch.context() as patched:
        patched.setattr(objective_module, "occupancy_loss", spoilt)
        trainer.advance()
    for _ in range(3):
        trainer.advance()  # finite, but after one that was not
    with pytest.raises(Diverged, match=f"diverged: the {what} is nan at step 6; lower training.learning_rate"):
        trainer.settle()
    assert trainer.step == 6
    assert all(torch.equal(*pair) for pair in zip(before, trainer.optimizer.tensors(), strict=True))


def test_a_resumed_run_draws_the_same(store, caplog):
    whole, first = trainer_for(store, refresh_cells_every=5), trainer_for(store, refresh_cells_every=5)
    wanted = advance_to(whole, 14)
    advance_to(first, 8)
    second = trainer_for(store, refresh_cells_every=5)
    second.restore(first.state(), "checkpoint.pt")
    assert advance_to(second, 14) == pytest.approx(wanted[8:], rel=1e-5)
    on_the_host = trainer_for(store, refresh_cells_every=5, graph="off")
    with caplog.at_level(logging.INFO):
        on_the_host.restore(first.state(), "checkpoint.pt")  # as on a machine without a GPU
    assert on_the_host.step == 8
    assert caplog.messages[-1].startswith("other random numbers than before from here on: ")


def test_the_loop_reports_every_step_once(store, tmp_path):
    trainer = trainer_for(store, steps=70, validate_every=60, checkpoint_every=60)
    scalars = []
    result = train(trainer, tmp_path, on_scalars=lambda step, numbers: scalars.append((step, numbers)))
    assert [step for step, numbers in scalars if "total" in numbers] == [20, 40, 60, 70]
    assert all(math.isfinite(value) for _, numbers in scalars for value in numbers.values())
    assert result["steps_this_run"] == 70
    assert (tmp_path / "checkpoint.pt").exists()


def test_validations_and_checkpoints_are_those_of_steps_that_were_taken(store, tmp_path, monkeypatch):
    trainer = trainer_for(store, steps=24, validate_every=9, checkpoint_every=12)
    validated, true_state, true_advance = [], trainer.state, trainer.advance

    def advance() -> StepNumbers:
        if trainer.step in (6, 10):  # for all steps until the host looks
            trainer._ahead._static.capacity = 10
        return true_advance()

    def state() -> dict[str, object]:
        before = trainer.step
        content = true_state()
        assert content["step"] == trainer.step == before
        return content

    monkeypatch.setattr(trainer, "advance", advance)
    monkeypatch.setattr(trainer, "state", state)
    monkeypatch.setattr(trainer, "validate", lambda: validated.append(trainer.step) or {"iou_bbox": 0.5, "iou_surface": 0.5})
    told = []
    train(trainer, tmp_path, on_scalars=lambda step, numbers: told.append(step) if "validation_iou_bbox" in numbers else None)
    assert told == validated == [9, 18, 24]


# ---------------------------------------------------------------- batches
def test_batches_hold_stored_points_of_different_frames(store):
    config = training_config(poses_per_step=8, uniform_points=30, surface_points=20, graph="on")
    batches = DeviceBatches(store, config, 3, CPU)
    (sequence,) = store.sequences("train")
    assert len(batches.frames) > 8
    seen = set()
    for step in range(12):
        batch = batches.batch(step)
        frames = [int((pose == torch.tensor(sequence.poses)).all(2).all(1).nonzero()[0]) for pose in batch.pose]
        assert len(set(frames)) == len(frames)
        assert set(frames) <= set(sequence.train_frames.tolist())
        seen |= set(frames)
        for b, frame in enumerate(frames):
            points, labels = torch.tensor(sequence.points(frame)), torch.tensor(sequence.occupancies(frame))
            same = (batch.points[b][:, None] == points).all(2)
            assert same.any(1).all()
            assert same[:30, : sequence.num_uniform].any(1).all()
            assert same[30:, sequence.num_uniform :].any(1).all()
            assert torch.equal(labels[same.float().argmax(1)], batch.occupied[b])
            assert torch.equal(batch.bone_transforms[b], torch.tensor(sequence.bone_transforms[frame]))
            assert torch.equal(batch.cube[b], torch.stack([torch.tensor(corner) for corner in sequence.cube(frame)]))
    assert seen == set(sequence.train_frames.tolist())
    assert not torch.equal(batches.batch(0).points, batches.batch(1).points)
    assert torch.equal(batches.batch(1).points, DeviceBatches(store, config, 3, CPU).batch(torch.tensor(1)).points)


def test_frames_repeat_only_if_there_are_too_few(store):
    config = training_config(poses_per_step=40, uniform_points=2, surface_points=2, graph="on")
    assert DeviceBatches(store, config, 0, CPU).batch(0).points.shape == (40, 4, 3)


# ---------------------------------------------------------------- choice
@pytest.mark.parametrize(
    ("changes", "name", "line"),
    [
        ({"graph": "on", "refine_poses": True}, "fast_snarf", "training.refine_poses=true changes the samples"),
        ({"graph": "on"}, "snarf", "a search in the weight field itself, as of model=snarf"),
        ({"graph": "on"}, "fast_snarf", "training.graph=on: steps have fixed shapes, and are not captured"),
        ({"graph": "auto"}, "fast_snarf", None),
        ({"graph": "off", "fresh_points": True}, "fast_snarf", None),
    ],
)
def test_one_line_says_why_steps_are_not_captured(store, caplog, changes, name, line):
    architecture = avatar_config()
    if name == "snarf":
        search = replace(architecture.search, name="broyden")
        architecture = replace(architecture, model=replace(architecture.model, name="snarf"), search=search)
    with caplog.at_level(logging.INFO):
        trainer = trainer_for(store, architecture, **changes)
    told = [record.message for record in caplog.records]
    assert len(told) == (line is not None)
    assert line is None or line in told[0]
    assert (trainer._ahead is not None) == (line is not None and line.startswith("training.graph=on:"))


def test_an_unknown_choice_is_refused(store):
    with pytest.raises(ValueError, match=r"training\.graph: wanted auto, on or off, got 'maybe'"):
        trainer_for(store, graph="maybe")


def test_kinds_of_steps():
    config = training_config(bootstrap_steps=3, agreement_weight=1.0, agreement_every=2)
    kinds = [kind_of(config, step) for step in range(6)]
    assert [kind.bootstraps for kind in kinds] == [True, True, True, False, False, False]
    assert [kind.agrees for kind in kinds] == [False, False, True, False, True, False]
    assert not kind_of(replace(config, agreement_weight=0.0), 2).agrees
