"""Training steps on the pretend GPU: nothing waits, nothing is copied, and captured steps are those of the eager run."""

from __future__ import annotations

import pytest
from pretend_gpu.run import Report, run_on_pretend_gpu
from toy_training import toy_store

from snarfcli.models.trained_field import SYSTEMS

MODELS = [name for name in SYSTEMS if name not in ("fast_snarf", "snarf")]  # snarf has no step with fixed shapes
PRESETS = ["paper", "quick", *(f"quick model={name} condition=none" for name in MODELS), "quick search=broyden"]

STEPS = """
    import sys
    from functools import partial

    import torch
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf
    from pretend_gpu.device import CUDA, watch

    from snarfcli.commands.train import TrainConfig, new_trainer
    from snarfcli.draws import HashedDraws
    from snarfcli.hydra_config.schema import config_folder, register_schemas
    from snarfcli.samples.store import SampleStore
    from snarfcli.training.schedule import StepKind
    from snarfcli.training.static_step import StaticStep

    SMALL = [
        "training.poses_per_step=2", "training.uniform_points=40", "training.surface_points=40",
        "training.agreement_points=40", "skinning.resolution=[12,12,6]",
    ]
    register_schemas("train", TrainConfig)
    store = SampleStore.open(sys.argv[1], "builtin", "toy")
    for preset in sys.argv[2:]:
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            config = OmegaConf.to_object(compose("train", [*SMALL, *f"training={preset}".split()]))
        torch.manual_seed(0)
        trainer = new_trainer(config, store, CUDA)
        step = StaticStep(trainer.objective, trainer.batches, trainer.optimizer)
        trainer.model.keep_room()
        step.capacity = 2000
        step.run(StepKind(True, True))  # makes the constants
        for kind in (StepKind(True, True), *([StepKind(False, False)] if preset in ("paper", "quick") else [])):
            with watch(f"{preset}: {kind.bootstraps}"):
                step.run(kind)
        progress = step.progress()
        assert progress.step >= 2 and not progress.is_halted, progress
"""


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    toy_store(root, points=200, frames=10)
    return root


@pytest.fixture(scope="module")
def steps(samples) -> Report:
    return run_on_pretend_gpu(STEPS, samples, *PRESETS)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_static_step_neither_waits_nor_copies_nor_mixes(steps, preset):
    watched = [seen for seen in steps.seen if seen.name.startswith(f"{preset}: ")]
    assert watched
    for seen in watched:
        assert (seen.mixing, seen.waits, seen.copies) == ([], [], [])
        assert seen.kernels > 50


def test_a_static_step_has_few_kernels(steps):
    """Bounds a little above what they are, so that an operator in a loop shows: 353 and 331, eagerly 1008 and 479."""
    assert steps["paper: False"].kernels < 380
    assert steps["quick: False"].kernels < 360


RUNS = """
    import logging
    import sys
    from dataclasses import replace

    import torch
    from pretend_gpu.device import CUDA, watch
    from toy_training import avatar_config, new_avatar, training_config

    from snarfcli.samples.store import SampleStore
    from snarfcli.training import graphs
    from snarfcli.training.schedule import kind_of
    from snarfcli.training.trainer import Trainer

    graphs._WARM_UP_STEPS = 1
    logging.basicConfig(level=logging.DEBUG, stream=sys.stdout, format="%(message)s")
    plain = avatar_config(capsules=True, condition="local")
    shape = replace(plain.shape, name="grid", feature_cells_m=[0.2, 0.08], width=16)
    skinning = replace(plain.skinning, name="voxel", smoothness=1e-3, resolution=[10, 8, 6])
    config = training_config(
        steps=18, learning_rate=1e-3, refresh_cells_every=12, extend_weights_every=12, agreement_weight=1.0, bootstrap_steps=9,
        poses_per_step=2, uniform_points=30, surface_points=30, agreement_points=30, graph="auto", joint_weight=0.1,
    )

    def run(graph, steps, spoil=lambda trainer: None):
        torch.manual_seed(0)
        store = SampleStore.open(sys.argv[1], "builtin", "toy")
        trainer = Trainer(new_avatar(store, replace(plain, shape=shape, skinning=skinning)), store, config, 0, CUDA)
        if not graph:
            trainer._ahead = None
        losses = {}
        while trainer.step < steps:
            spoil(trainer)
            loss = trainer.advance()["total"]
            losses[trainer.step - 1] = loss  # after a halt, that of the step that is taken again
        return trainer, losses

    def compare(some, others):
        worst = max(abs(some[step] / others[step] - 1) for step in some)
        assert worst < 1e-4, worst

    def make_small(trainer):
        if trainer.step == 16:
            trainer._ahead._static.capacity = 10
            trainer._ahead._graphs.drop()

    _, eager = run(graph=False, steps=18)
    trainer, captured = run(graph=True, steps=18, spoil=make_small)
    compare(captured, eager)
    assert len(captured) == len(eager)
    assert trainer._ahead._static.capacity > 10
    trainer.finished_avatar()
    assert trainer.validate()["iou_bbox"] >= 0

    in_pytorch = replace(plain, search=replace(plain.search, backend="reference"))
    store = SampleStore.open(sys.argv[1], "builtin", "toy")
    assert Trainer(new_avatar(store, in_pytorch), store, config, 0, CUDA)._ahead is None

    class Full:
        def __init__(self, *arguments, **options): ...
        def __enter__(self): raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB")
        def __exit__(self, *exception): ...

    config.fresh_points = True
    _, eager_fresh = run(graph=False, steps=7)
    trainer, fresh = run(graph=True, steps=6)
    with watch("fresh"):
        trainer._ahead.run(6, kind_of(config, 6))
    compare(fresh, eager_fresh)
    config.fresh_points = False
    torch.cuda.graph = Full
    trainer, full = run(graph=True, steps=7)
    compare(full, eager)
    assert trainer._ahead is None
"""


def test_captured_steps_are_those_of_the_eager_run(samples):
    """Through refreshed cells, grown grids, extended weights and a capacity that is too small, with all four kinds of steps.

    Also with fresh points, which the GPU copies from pinned memory. If there is no memory for a capture, the run goes on
    eagerly, with one line.
    """
    report = run_on_pretend_gpu(RUNS, samples)
    lines = report.output.splitlines()
    captured = {line for line in lines if line.startswith("captured a step: ")}
    assert len(captured) == 4
    assert (report["fresh"].mixing, report["fresh"].copies) == ([], [])
    (wait,) = report["fresh"].waits
    assert "Event.synchronize" in wait  # for the copy of three steps before
    why = "the search in PyTorch waits for the GPU (search.backend=reference)"
    assert lines.count(f"the training step is not captured in a CUDA graph: {why}") == 1
    assert lines.count("steps are not captured in a CUDA graph from here on: there is not enough memory on the GPU") == 1
