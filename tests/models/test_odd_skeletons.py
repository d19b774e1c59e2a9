"""Skeletons that are none of SMPL's: one joint, several roots, bones without length; and the start bones of a search."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from toy_subject import capsule_mesh
from toy_training import avatar_config, new_avatar, training_config

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton
from snarfcli.bodies.extent import bone_segments
from snarfcli.datasets.posed_meshes import RigMeshes
from snarfcli.datasets.subjects import SequenceSpec, SubjectData
from snarfcli.deformer import SearchConfig
from snarfcli.errors import UserError
from snarfcli.meshing.posed import posed_mesh
from snarfcli.models.start_bones import with_start_bones
from snarfcli.motions import Motion
from snarfcli.samples.preprocessing import preprocess_subject
from snarfcli.samples.store import SampleStore
from snarfcli.sampling import SamplingSettings
from snarfcli.training.trainer import Trainer

# Along the capsule, which lies on x from 0 to 1 m: parents and places.
ODD = {
    "one joint": ((-1,), [0.2]),
    "two roots": ((-1, 0, -1, 2), [0.0, 0.3, 1.0, 0.6]),
    "a root alone": ((-1, 0, -1), [0.0, 0.5, 1.0]),
    "bones without length": ((-1, 0, 1, 1), [0.0, 0.5, 0.5, 0.5]),
}


def skeleton_of(parents: tuple[int, ...], places: list[float]) -> Skeleton:
    joints = torch.zeros(len(parents), 3)
    joints[:, 0] = torch.tensor(places)
    return Skeleton(tuple(f"j{i}" for i in range(len(parents))), parents, joints, torch.zeros(len(parents), 3))


def odd_store(root, name: str) -> SampleStore:
    skeleton = skeleton_of(*ODD[name])
    vertices, faces = capsule_mesh(1.0, 0.1, around=12, along=12, cap=3)
    nearest = np.abs(vertices[:, None, 0] - skeleton.joints_rest[:, 0].numpy()).argmin(1)
    weights = np.eye(skeleton.num_joints)[nearest]
    poses = np.zeros((4, skeleton.num_joints, 3))
    poses[:, -1, 2] = 0.1 * np.arange(4)
    transforms = skeleton.to(torch.float64).posed_from_rest(torch.from_numpy(poses)).numpy()
    motion = Motion("turn", poses, np.zeros((4, 3)), 30.0)
    spec = SequenceSpec("turn", "train", motion, RigMeshes(vertices, faces, weights, transforms))
    sampling = SamplingSettings(points_per_frame=800, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0)
    preprocess_subject(SubjectData("meshes", "odd", skeleton, (spec,)), root, sampling, {"train": 1, "test": 1, "ood": 1})
    return SampleStore.open(root, "meshes", "odd")


@pytest.mark.parametrize("name", ODD)
def test_odd_skeletons_train_with_every_search_and_softmax(name, tmp_path):
    store = odd_store(tmp_path, name)
    for search, softmax in (("complete", "plain"), ("complete", "hierarchical"), ("broyden", "plain")):
        config = avatar_config(capsules=True, name=search)
        config.skinning.softmax = softmax
        config.search = with_start_bones(config.search, store.skeleton)
        training = training_config(steps=3, bootstrap_steps=2, refresh_cells_every=2)
        trainer = Trainer(new_avatar(store, config), store, training, 0, torch.device("cpu"))
        losses = [trainer.advance()["total"] for _ in range(3)]
        assert np.isfinite(losses).all()
    avatar = trainer.finished_avatar()
    mesh = posed_mesh(avatar, torch.from_numpy(store.sequences("train")[0].poses[3]), None, 24)
    assert np.isfinite(mesh.vertices).all()
    assert np.ptp(mesh.vertices[:, 0]) > 0.1


@pytest.mark.parametrize("name", ODD)
def test_poses_of_odd_skeletons_can_be_refined(name, tmp_path, monkeypatch):
    monkeypatch.setattr("snarfcli.training.trainer._REFINE_FROM", 2)
    store = odd_store(tmp_path, name)
    training = training_config(steps=8, bootstrap_steps=2, refresh_cells_every=2, refine_poses=True, agreement_weight=1.0)
    trainer = Trainer(new_avatar(store, avatar_config(capsules=True)), store, training, 0, torch.device("cpu"))
    losses = [trainer.advance()["total"] for _ in range(8)]
    assert np.isfinite(losses).all()
    avatar = trainer.finished_avatar()
    trainer.refiner.finish(avatar)
    assert trainer.refiner.poses.summary()["frames"] == 4
    assert np.isfinite(trainer.store.sequences("train")[0].poses).all()


def test_a_root_alone_is_a_point_among_the_bones():
    bones = bone_segments(skeleton_of(*ODD["a root alone"]))
    assert bones.shape == (2, 2, 3)
    torch.testing.assert_close(bones[1], torch.tensor([[1.0, 0, 0]] * 2))


def test_an_empty_list_of_start_bones_follows_the_skeleton():
    smpl = Skeleton(SMPL_JOINT_NAMES, (-1,) + (0,) * 23, torch.zeros(24, 3), torch.zeros(24, 3))
    other = skeleton_of(*ODD["two roots"])
    empty = SearchConfig(name="broyden", init_bones=[])
    assert with_start_bones(empty, smpl).init_bones == [0, 1, 2, 4, 5, 16, 17, 18, 19]
    assert with_start_bones(empty, other).init_bones is None
    given = SearchConfig(name="broyden", init_bones=[0, 3])
    assert with_start_bones(given, other) is given
    with pytest.raises(UserError, match=r"search.init_bones: wanted bones from 0 to 3, got \[4\]; null starts from all bones"):
        with_start_bones(SearchConfig(name="broyden", init_bones=[4]), other)
