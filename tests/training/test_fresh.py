"""Fresh points: equal in every process, labelled exactly, fit for training; no process is left afterwards."""

from __future__ import annotations

import multiprocessing
import pickle
import shutil
from dataclasses import replace

import igl
import numpy as np
import pytest
import torch
from toy_subject import capsule_mesh, toy_subject
from toy_training import new_avatar, toy_store, training_config

from snarfcli.errors import UserError
from snarfcli.samples.preprocessing import preprocess_subject
from snarfcli.samples.store import SampleStore
from snarfcli.sampling import SamplingSettings
from snarfcli.training.batches import FreshBatches, new_batches
from snarfcli.training.fresh import FreshPoints
from snarfcli.training.loop import train
from snarfcli.training.trainer import Trainer

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return toy_store(tmp_path_factory.mktemp("toy"), points=2400)


@pytest.fixture(autouse=True)
def no_process_is_left():
    yield
    assert not multiprocessing.active_children()


def batches_for(store, workers, **changes):
    config = training_config(fresh_points=True, workers=workers, **changes)
    batches = new_batches(store, config, 5, CPU)
    assert isinstance(batches, FreshBatches)
    return batches


def trainer_for(store, **changes):
    torch.manual_seed(0)
    return Trainer(new_avatar(store), store, training_config(fresh_points=True, **changes), 0, CPU)


def same(a, b) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("points", "occupied", "bone_transforms", "pose"))


def test_a_step_is_the_same_in_every_process(store) -> None:
    here = batches_for(store, 0)
    expected = [here.batch(step) for step in range(9)]
    assert not same(expected[0], expected[1])
    for workers in (1, 3):
        ahead = batches_for(store, workers)
        try:
            for step in (2, 3, 4, 5, 8, 0, 1):  # a resumed run starts anywhere
                assert same(ahead.batch(step), expected[step])
            assert len(multiprocessing.active_children()) == workers
        finally:
            ahead.close()
        assert not multiprocessing.active_children()
    assert not same(batches_for(store, 0).batch(0), new_batches(store, training_config(), 5, CPU).batch(0))


def exact_labels(sequence, frame, points) -> np.ndarray:
    vertices, faces = sequence.vertices(frame).astype(np.float64), sequence.faces(frame).astype(np.int64)
    return np.asarray(igl.winding_number(vertices, faces, points.astype(np.float64))).reshape(-1) > 0.5


def check_labels(fresh: FreshPoints, steps: int) -> None:
    for step in range(steps):
        drawn = fresh.draw(step)
        for (sequence, frame), points, occupied in zip(drawn.frames, drawn.points, drawn.occupied, strict=True):
            np.testing.assert_array_equal(occupied, exact_labels(fresh.sequences[sequence], frame, points))
            lower, upper = fresh.sequences[sequence].cube(frame)
            assert (points >= lower).all()
            assert (points <= upper).all()


def test_points_lie_as_the_stored_ones_do(store) -> None:
    fresh = FreshPoints(store.sequences("train"), store.manifest["settings"], 4, 1000, 2000, 0)
    check_labels(fresh, 2)
    drawn = fresh.draw(7)
    sequence, frame = fresh.sequences[drawn.frames[0][0]], drawn.frames[0][1]
    lower, upper = sequence.cube(frame)
    share = (drawn.points[0, :1000] - lower) / (upper - lower)
    assert np.abs(share.mean(0) - 0.5).max() < 4 * np.sqrt(1 / 12 / 1000)  # four sigma
    vertices, faces = sequence.vertices(frame).astype(np.float64), sequence.faces(frame).astype(np.int64)
    squared = igl.point_mesh_squared_distance(drawn.points[0, 1000:].astype(np.float64), vertices, faces)[0]
    # the distance to a flat surface is one axis of the noise; 2000 values: 1.6 % is one sigma, curvature adds a little
    assert np.sqrt(squared.mean()) == pytest.approx(store.manifest["settings"]["surface_noise_m"], rel=0.07)


class _GrowingMeshes:
    """Open capsules whose number of triangles changes from frame to frame."""

    def __init__(self, frames=range(12)) -> None:
        self.frames = list(frames)

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int):
        vertices, faces = capsule_mesh(0.5, 0.1, around=12 + 2 * (int(self.frames[index]) // 4))
        return vertices, np.delete(faces, [10, 11], axis=0)

    def chosen(self, frames):
        return _GrowingMeshes([self.frames[frame] for frame in frames])

    def source(self, index: int) -> str:
        return ""

    def fingerprint(self) -> str:
        return ""


def test_open_meshes_of_changing_topology(tmp_path) -> None:
    subject = toy_subject(train_frames=12)
    specs = tuple(replace(spec, meshes=_GrowingMeshes()) for spec in subject.sequences if spec.split == "train")
    subject = replace(subject, sequences=specs, template=None)
    sampling = SamplingSettings(points_per_frame=80, surface_noise_m=0.02, padding=0.1, inside_test="winding", seed=0)
    preprocess_subject(subject, tmp_path, sampling, {"train": 1, "test": 1, "ood": 1})
    store = SampleStore.open(tmp_path, "builtin", "toy")
    sequence = store.sequences("train")[0]
    assert len({len(sequence.faces(frame)) for frame in range(sequence.num_frames)}) > 1
    check_labels(FreshPoints([sequence], store.manifest["settings"], 11, 200, 200, 0), 1)
    only_near = FreshPoints([sequence], store.manifest["settings"], 1, 0, 16, 0)
    assert only_near.draw(0).points.shape == (1, 16, 3)


def test_pickles_hold_places_not_points(store) -> None:
    fresh = batches_for(store, 0)._fresh
    data = pickle.dumps(fresh)
    assert len(data) < 20_000 < store.manifest["bytes"]
    again, drawn = pickle.loads(data).draw(3), fresh.draw(3)
    assert again.frames == drawn.frames
    np.testing.assert_array_equal(again.points, drawn.points)


def test_learns_from_fresh_points(store, tmp_path) -> None:
    result = train(trainer_for(store, workers=1), tmp_path, on_scalars=lambda step, numbers: None)
    assert result["validation"]["iou_bbox"] > 0.8
    assert result["validation"]["iou_surface"] > 0.7


def test_resumed_training_equals_an_uninterrupted_one(store, tmp_path) -> None:
    whole = trainer_for(store, workers=0, steps=8)
    for _ in range(8):
        whole.advance()
    first = trainer_for(store, workers=0, steps=8)
    for _ in range(3):
        first.advance()
    resumed = trainer_for(store, workers=2, steps=8)
    resumed.restore(first.state(), "checkpoint.pt")  # with another number of workers
    while resumed.step < 8:
        resumed.advance()
    resumed.batches.close()
    for a, b in zip(whole.optimizer.parameters, resumed.optimizer.parameters, strict=True):
        assert torch.equal(a, b)
    other = Trainer(new_avatar(store), store, training_config(workers=0, steps=8), 0, CPU)
    with pytest.raises(UserError, match=r"training.fresh_points: True there, False here"):
        other.restore(first.state(), "checkpoint.pt")


def test_a_failure_of_a_worker_ends_the_training_in_one_line(tmp_path) -> None:
    store = toy_store(tmp_path, frames=12)
    trainer = trainer_for(store, workers=2, steps=30)
    advance = trainer.advance

    def advance_and_lose_the_samples():
        numbers = advance()
        if trainer.step == 2:
            trainer.batches.close()  # the next ones open the files anew
            shutil.rmtree(store.sequences("train")[0].folder)
        return numbers

    trainer.advance = advance_and_lose_the_samples
    with pytest.raises(UserError, match=r"the samples are damaged: .*points.npy is missing") as caught:
        train(trainer, tmp_path, on_scalars=lambda step, numbers: None)
    assert "\n" not in str(caught.value)


def test_interrupting_the_training_ends_the_workers(store, tmp_path) -> None:
    trainer = trainer_for(store, workers=2)
    advance = trainer.advance

    def advance_and_interrupt():
        if trainer.step == 2:
            raise KeyboardInterrupt
        return advance()

    trainer.advance = advance_and_interrupt
    with pytest.raises(KeyboardInterrupt):
        train(trainer, tmp_path, on_scalars=lambda step, numbers: None)
    assert not multiprocessing.active_children()
