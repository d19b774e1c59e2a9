"""Training with poses that are only nearly right."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from toy_training import avatar_config, new_avatar, toy_store, training_config

from snarfcli.datasets.skeleton_files import read_poses, read_skeleton
from snarfcli.fitting import Corrections, Corrector
from snarfcli.models.checkpoint import load_checkpoint
from snarfcli.samples.store import SampleStore
from snarfcli.training.trainer import CHECKPOINT_FORMAT, CHECKPOINT_VERSION, Trainer

CPU = torch.device("cpu")
NOISE_RAD, NOISE_M = 0.06, 0.02


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Samples whose poses are noisy, independently in each frame."""
    store = toy_store(tmp_path_factory.mktemp("toy"), points=2400)
    generator = torch.Generator().manual_seed(0)
    for sequence in store.all_sequences:
        count = sequence.num_frames
        noise = Corrections(
            NOISE_RAD * torch.randn(count, 2, 3, generator=generator), NOISE_M * torch.randn(count, 3, generator=generator)
        )
        given = torch.as_tensor(sequence.bone_transforms), torch.as_tensor(sequence.poses)
        transforms, poses = Corrector(store.skeleton, CPU).correct(*given, noise)
        with np.load(sequence.folder / "frames.npz") as archive:
            arrays = dict(archive)
        arrays |= {"posed_from_canonical": transforms.numpy(), "poses": poses.numpy()}
        arrays["translation"] = arrays["translation"] + noise.shift.numpy()
        np.savez(sequence.folder / "frames.npz", **arrays)
    return store


def noisy_store(store: SampleStore) -> SampleStore:
    manifest = {**store.manifest}
    for entry in manifest["sequences"]:
        entry["files"]["frames.npz"]["bytes"] = (store.folder / entry["split"] / entry["name"] / "frames.npz").stat().st_size
    return SampleStore(store.folder, manifest)


def new_trainer(store: SampleStore, **changes: object) -> Trainer:
    torch.manual_seed(0)
    config = training_config(steps=300, agreement_weight=1.0, **changes)
    return Trainer(new_avatar(store, avatar_config(capsules=True)), store, config, 0, CPU)


def spread_of_tips(trainer: Trainer) -> float:
    """Return how far the tip of the body, the last vertex of its mesh, moves in the frame of the second bone, metres.

    With the true poses it rests there; a common error of all poses makes no difference.
    """
    places = []
    for sequence in trainer.store.sequences("train"):
        for frame in sequence.train_frames:
            tip = np.append(sequence.vertices(frame)[-1], 1)
            places.append((np.linalg.inv(sequence.bone_transforms[frame][1]) @ tip)[:3])
    return float(np.linalg.norm(np.std(places, 0)))


def test_poses_are_refined_while_the_avatar_is_learned(folder, tmp_path):
    store = noisy_store(folder)
    refining, given = new_trainer(store, refine_poses=True), new_trainer(store)
    start = spread_of_tips(refining)
    for trainer in (refining, given):
        while trainer.step < 300:
            trainer.advance()
    assert start > 0.05
    assert spread_of_tips(given) == start  # the samples themselves are not changed
    assert spread_of_tips(refining) < 0.4 * start
    better, worse = refining.validate(), given.validate()
    assert better["iou_surface"] > worse["iou_surface"] + 0.15
    avatar = refining.finished_avatar()
    refining.refiner.finish(avatar)
    summary = refining.refiner.poses.summary()
    assert summary["frames"] == sum(s.num_frames for s in store.sequences("train"))
    assert summary["distance_m"] < 0.012
    assert summary["turn_deg"] > 3
    assert avatar.facts["subject"] == "toy"

    path = tmp_path / "refined_poses.npz"
    refining.refiner.poses.write(path)
    poses = read_poses(path, read_skeleton(path).order)
    assert poses.num_frames == summary["frames"]
    np.testing.assert_allclose(poses.poses, np.concatenate([s.poses for s in refining.store.sequences("train")]), atol=1e-6)
    with np.load(path) as archive:
        assert archive["frames"].tolist() == list(range(poses.num_frames))
        assert set(archive["sequences"].tolist()) == {s.name for s in store.sequences("train")}


def test_resumed_training_has_the_same_poses(folder, tmp_path):
    store = noisy_store(folder)
    whole, first, second = (new_trainer(store, refine_poses=True) for _ in range(3))
    while whole.step < 112:
        whole.advance()
    while first.step < 106:
        first.advance()
    torch.save(first.state(), tmp_path / "checkpoint.pt")
    second.restore(load_checkpoint(tmp_path / "checkpoint.pt", CHECKPOINT_FORMAT, CHECKPOINT_VERSION, "checkpoint"), "here")
    while second.step < 112:
        second.advance()
    for mine, theirs in zip(second.store.sequences("train"), whole.store.sequences("train"), strict=True):
        np.testing.assert_array_equal(mine.poses, theirs.poses)
        np.testing.assert_array_equal(mine.bone_transforms, theirs.bone_transforms)
    for mine, theirs in zip(second.optimizer.parameters, whole.optimizer.parameters, strict=True):
        assert torch.equal(mine, theirs)


def test_meshes_that_cannot_be_reached_are_counted(folder):
    trainer = new_trainer(noisy_store(folder), refine_poses=True)
    poses, sequence = trainer.refiner.poses, trainer.store.sequences("train")[0]
    vertices = sequence.vertices
    sequence.vertices = lambda frame: vertices(frame) + (3.0 if frame in (4, 5) else 0.0)
    while trainer.step < 112:
        trainer.advance()
    trainer.refiner.finish(trainer.finished_avatar())
    assert poses.count_misfits() >= 2
    given = noisy_store(folder).sequences("train")[0]
    np.testing.assert_allclose(sequence.poses[4:6], given.poses[4:6], atol=1e-5)
    np.testing.assert_allclose(sequence.translation[4:6], given.translation[4:6], atol=1e-6)
    assert (poses.distance_m == torch.inf).nonzero()[:, 0].tolist() == [4, 5]
    assert poses.summary()["distance_m"] < 0.03


def test_validation_does_not_change_training(folder):
    trainers = [new_trainer(noisy_store(folder), refine_poses=True) for _ in range(2)]
    for trainer in trainers:
        while trainer.step < 112:
            if trainer is trainers[0] and trainer.step == 108:
                assert trainer.validate() == trainer.validate()
            trainer.advance()
    for mine, theirs in zip(*(trainer.store.sequences("train") for trainer in trainers), strict=True):
        np.testing.assert_array_equal(mine.poses, theirs.poses)
    for mine, theirs in zip(*(trainer.optimizer.parameters for trainer in trainers), strict=True):
        assert torch.equal(mine, theirs)


def test_planar_samples_and_other_systems_are_refused(folder):
    store = noisy_store(folder)
    store.manifest["settings"] = {**store.manifest["settings"], "is_planar": True}
    with pytest.raises(ValueError, match=r"training.refine_poses: wanted samples of surfaces in space, got planar ones"):
        new_trainer(store, refine_poses=True)
