"""Training on a bending capsule: it learns, it resumes exactly, it can be interrupted."""

from __future__ import annotations

import itertools
import signal
from dataclasses import replace

import pytest
import torch
from toy_training import avatar_config, new_avatar, toy_store, training_config

from snarfcli.avatar import Avatar
from snarfcli.bodies.extent import unpose_by_nearest_bone
from snarfcli.errors import UserError
from snarfcli.interrupts import SIGNALS, exit_code
from snarfcli.models.checkpoint import load_checkpoint
from snarfcli.training import loop
from snarfcli.training.loop import train
from snarfcli.training.trainer import CHECKPOINT_FORMAT, CHECKPOINT_VERSION, Trainer

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return toy_store(tmp_path_factory.mktemp("toy"), points=2400)


def trainer_for(store, **changes):
    torch.manual_seed(0)
    return Trainer(new_avatar(store), store, training_config(**changes), 0, CPU)


def test_learns_shape_and_weights(store, tmp_path):
    trainer = trainer_for(store)
    scalars = []
    result = train(trainer, tmp_path, on_scalars=lambda step, numbers: scalars.append((step, numbers)))
    assert result["validation"]["iou_bbox"] > 0.8
    assert result["validation"]["iou_surface"] > 0.7
    assert result["inside_without_correspondence"] < 0.01
    assert result["points_per_second"] > 0
    assert scalars[-1][0] == 150
    avatar = trainer.averaged_avatar()
    ends = torch.tensor([[0.1, 0.0, 0.0], [0.9, 0.0, 0.0]])
    weights = avatar.skinning_weights(ends)
    assert weights[0, 0] > 0.9
    assert weights[1, 1] > 0.9
    test = store.sequences("ood")[0]
    pose = torch.as_tensor(test.poses[:1])
    transforms = torch.as_tensor(test.bone_transforms[:1])
    inside = avatar.query(torch.as_tensor(test.points(0))[None], transforms, pose).logits[0] > 0
    truth = torch.as_tensor(test.occupancies(0))
    assert float((inside & truth).sum() / (inside | truth).sum()) > 0.6  # bent further than ever seen


@pytest.mark.parametrize(
    ("condition", "feature_cells_m", "interrupted_at"), [("global", [], 7), ("local", [], 10), ("local", [0.2, 0.1], 7)]
)
def test_resumed_training_equals_an_uninterrupted_one(store, tmp_path, condition, feature_cells_m, interrupted_at):
    # The searched cells, and the feature grids, change before the interruption and after it, at step 10 as the first thing.
    config, architecture = training_config(steps=12, refresh_cells_every=5), avatar_config(condition=condition)
    architecture = replace(architecture, shape=replace(architecture.shape, feature_cells_m=feature_cells_m))

    def fresh():
        torch.manual_seed(0)
        return Trainer(new_avatar(store, architecture), store, config, 0, CPU)

    whole = fresh()
    for _ in range(12):
        whole.advance()
    first = fresh()
    for _ in range(interrupted_at):
        first.advance()
    torch.save(first.state(), tmp_path / "checkpoint.pt")
    second = fresh()
    torch.manual_seed(99)
    second.restore(load_checkpoint(tmp_path / "checkpoint.pt", CHECKPOINT_FORMAT, CHECKPOINT_VERSION, "checkpoint"), "here")
    assert second.step == interrupted_at
    for _ in range(12 - interrupted_at):
        second.advance()
    for mine, theirs in zip(
        second.optimizer.parameters + second.optimizer.average,
        whole.optimizer.parameters + whole.optimizer.average,
        strict=True,
    ):
        assert torch.equal(mine, theirs)
    cells = [trainer.model.deformer.active_cells for trainer in (second, whole)]
    assert torch.equal(*cells)


def test_other_settings_cannot_be_resumed(store):
    state = trainer_for(store).state()
    other = trainer_for(store, learning_rate=1e-4)
    with pytest.raises(UserError, match=r"training.learning_rate: 0.01 there, 0.0001 here"):
        other.restore(state, "checkpoint.pt")


def test_a_box_that_another_machine_has_rounded_differently_can_be_resumed(store):
    state = trainer_for(store).state()
    model = state["avatar"]["state"]
    model["deformer.upper"] = torch.nextafter(model["deformer.upper"], torch.tensor(torch.inf))
    resumed = trainer_for(store)
    resumed.restore(state, "checkpoint.pt")
    assert torch.equal(resumed.model.grid.upper, model["deformer.upper"])
    model["deformer.upper"] = model["deformer.upper"] + 0.01
    with pytest.raises(UserError, match="its canonical box is another"):
        trainer_for(store).restore(state, "checkpoint.pt")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_interrupt_ends_the_step_and_leaves_a_checkpoint(store, tmp_path, number, code):
    trainer = trainer_for(store)
    advance = trainer.advance

    def interrupted_advance():
        if trainer.step == 4:
            signal.raise_signal(number)
            signal.raise_signal(signal.SIGHUP)  # a closed terminal sends more than one
        return advance()

    trainer.advance = interrupted_advance
    handlers = {SIGNALS[0]: signal.default_int_handler} | dict.fromkeys(SIGNALS[1:], signal.SIG_DFL)
    # ignored where the tests run in the background of a script
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        with pytest.raises(KeyboardInterrupt) as interrupt:
            train(trainer, tmp_path, on_scalars=lambda step, numbers: None)
        assert {number: signal.getsignal(number) for number in SIGNALS} == handlers
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
    assert exit_code(interrupt.value) == code
    state = load_checkpoint(tmp_path / "checkpoint.pt", CHECKPOINT_FORMAT, CHECKPOINT_VERSION, "checkpoint")
    assert state["step"] == 5
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]
    again = trainer_for(store)
    again.restore(state, "checkpoint.pt")
    assert again.seconds == trainer.seconds > 0
    assert again.processor_s == trainer.processor_s == state["processor_s"] > 0
    again.restore({name: value for name, value in state.items() if name != "processor_s"}, "checkpoint.pt")
    assert again.processor_s is None, "the first part of the run did not record it"
    result = train(again, tmp_path, on_scalars=lambda step, numbers: None)
    assert result["processor_s"] is None


def test_a_checkpoint_knows_the_versions_of_the_code_that_took_its_steps(store):
    trainer = trainer_for(store)
    trainer.code = {"digest": "aaaaaaaaaaaa", "commit": "0123456789"}
    again = trainer_for(store)
    again.restore(trainer.state(), "checkpoint.pt")
    assert again.earlier_code == [trainer.code]
    assert again.state()["code"] == [trainer.code, again.code]
    same = trainer_for(store)
    same.restore(again.state(), "checkpoint.pt")
    assert same.earlier_code == [trainer.code]
    unknown = {name: value for name, value in trainer.state().items() if name != "code"}
    again.restore(unknown, "checkpoint.pt")
    assert again.earlier_code == [{}]
    for damaged in ("x", [3], [{"digest": 3}], [{3: "x"}]):
        with pytest.raises(UserError, match="does not fit this version"):
            again.restore(unknown | {"code": damaged}, "checkpoint.pt")


@pytest.mark.parametrize("begin", [0, 2])
def test_the_processor_time_is_that_of_the_steps_of_all_parts(store, tmp_path, monkeypatch, begin):
    """Of a clock that a step moves by 3 s and a validation by 100 s. A checkpoint is written before a step's validation."""
    clock = [50.0]
    trainer = trainer_for(store, steps=4, validate_every=2)
    trainer.step, trainer.processor_s = begin, 1000.0
    advance, validate = trainer.advance, trainer.validate

    def moving(call, seconds):
        clock[0] += seconds
        return call()

    monkeypatch.setattr(loop.time, "process_time", lambda: clock[0])
    monkeypatch.setattr(trainer, "advance", lambda: moving(advance, 3.0))
    monkeypatch.setattr(trainer, "validate", lambda: moving(validate, 100.0))
    result = train(trainer, tmp_path, on_scalars=lambda step, numbers: None)
    assert [one["step"] for one in trainer.validations] == [2, 4]
    assert result["processor_s"] == 1000.0 + (4 - begin) * 3.0


def test_learning_rate_warms_up_and_falls(store):
    trainer = trainer_for(store, warmup_steps=10, steps=100)
    rates = []
    for step in range(101):
        trainer.step = step
        rates.append(trainer.learning_rate())
    assert rates[0] == pytest.approx(1e-3, rel=1e-2)
    assert max(rates) == rates[9]
    assert rates[100] == pytest.approx(0.05 * 1e-2)
    assert all(a >= b for a, b in itertools.pairwise(rates[9:]))


def test_gradient_of_the_whole_model(store):
    """Posed occupancy loss to skinning and shape parameters in float64, against central differences."""
    torch.manual_seed(0)
    config = avatar_config(tolerance=1e-12, max_steps=30)
    config.shape.activation = "softplus"
    avatar = new_avatar(store, config)
    model = avatar.model.double().train()
    sequence = store.sequences("train")[0]
    points = torch.as_tensor(sequence.points(9)[400:460])[None].double()
    transforms = torch.as_tensor(sequence.bone_transforms[9:10]).double()
    pose = torch.as_tensor(sequence.poses[9:10]).double()
    goal = torch.randn(1, 60, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def loss():
        return (model(points, transforms, pose).logits.sigmoid() * goal).sum()

    parameters = list(model.parameters())
    gradients = torch.autograd.grad(loss(), parameters, allow_unused=True)
    generator = torch.Generator().manual_seed(2)
    checked = 0
    for parameter, gradient in zip(parameters, gradients, strict=True):
        direction = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
        step = 1e-6
        with torch.no_grad():
            parameter += step * direction
            ahead = loss()
            parameter -= 2 * step * direction
            behind = loss()
            parameter += step * direction
        numeric = float(ahead - behind) / (2 * step)
        analytic = 0.0 if gradient is None else float((gradient * direction).sum())
        assert analytic == pytest.approx(numeric, rel=2e-4, abs=1e-7)
        checked += abs(numeric) > 1e-6
    assert checked >= len(parameters) - 2


def test_unposing_by_the_nearest_bone_straightens_the_capsule(store):
    sequence = store.sequences("train")[0]
    bent = max(range(sequence.num_frames), key=lambda f: abs(sequence.poses[f, 1, 2]))
    vertices = torch.as_tensor(sequence.vertices(bent))
    canonical = torch.as_tensor(store.template.vertices)
    unposed = unpose_by_nearest_bone(vertices, torch.as_tensor(sequence.bone_transforms[bent]), store.skeleton)
    assert (vertices - canonical).norm(dim=1).max() > 0.3
    assert (unposed - canonical).norm(dim=1).max() < 0.12  # near the bend the nearest bone is not the right one
    assert (unposed - canonical).norm(dim=1).median() < 0.01


def test_averaged_avatar_shares_neither_surfaces_nor_facts_with_the_raw_one(store):
    trainer = trainer_for(store)
    raw = trainer.avatar.derived("surface", lambda: "of the raw weights")
    averaged = trainer.averaged_avatar()
    assert averaged.derived("surface", lambda: "of the averaged weights") == "of the averaged weights"
    assert trainer.avatar.derived("surface", lambda: "computed again") is raw
    averaged.facts["steps"] = 1
    assert "steps" not in trainer.avatar.facts


def test_avatar_file_holds_all_that_is_needed(store, tmp_path):
    trainer = trainer_for(store, steps=3)
    trainer.advance()
    avatar = trainer.averaged_avatar()
    avatar.save(tmp_path / "avatar.pt")
    again = Avatar.load(tmp_path / "avatar.pt")
    points = torch.rand(1, 200, 3, generator=torch.Generator().manual_seed(0))
    pose = torch.tensor([[[0.0, 0.0, 0.3], [0.0, 0.0, 0.7]]])
    assert torch.equal(avatar.occupancy(points, pose), again.occupancy(points, pose))
    assert again.facts == avatar.facts
    assert torch.equal(again.model.deformer.active_cells, avatar.model.deformer.active_cells)
    with pytest.raises(ValueError, match=r"pose: wanted shape \[B, 2, 3\], got \[1, 3, 3\]"):
        again.occupancy(points, torch.zeros(1, 3, 3))
