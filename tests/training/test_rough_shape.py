"""The rough canonical shape of a subject before training."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from toy_training import new_avatar

from snarfcli.bodies import Skeleton
from snarfcli.datasets.posed_meshes import ArrayMeshes
from snarfcli.datasets.subjects import SequenceSpec, SubjectData
from snarfcli.motions import Motion
from snarfcli.samples.preprocessing import preprocess_subject
from snarfcli.samples.store import SampleStore
from snarfcli.sampling import SamplingSettings


def test_a_large_part_beyond_the_last_joint_is_searched(tmp_path):
    """Its eight vertices are far apart, and no bone runs through it."""
    box = trimesh.creation.box(bounds=[[-0.15, 0.0, -0.15], [0.15, 1.5, 0.15]])
    skeleton = Skeleton(("root", "elbow"), (-1, 0), torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.2, 0.0]]), torch.zeros(2, 3))
    frames = 4
    motion = Motion("still", np.zeros((frames, 2, 3)), np.zeros((frames, 3)), 30.0)
    meshes = ArrayMeshes(np.tile(np.asarray(box.vertices), (frames, 1, 1)), np.asarray(box.faces))
    subject = SubjectData("builtin", "toy", skeleton, (SequenceSpec("still", "train", motion, meshes),))
    sampling = SamplingSettings(points_per_frame=4000, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0)
    preprocess_subject(subject, tmp_path, sampling, {"train": 1, "test": 1, "ood": 1})
    deformer = new_avatar(SampleStore.open(tmp_path, "builtin", "toy")).model.deformer
    lower, upper = torch.tensor(box.bounds, dtype=torch.float32)
    inside = lower + (upper - lower) * torch.rand(2000, 3, generator=torch.Generator().manual_seed(0))
    assert deformer.is_active(inside).float().mean() > 0.999
