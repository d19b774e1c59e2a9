"""The weight grid follows the proportions of a subject."""

from __future__ import annotations

import math

import torch

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton
from snarfcli.deformer import BodySkinningConfig
from snarfcli.deformer.grid_sides import with_grid_sides

OTHER = Skeleton(("a", "b"), (-1, 0), torch.zeros(2, 3), torch.zeros(2, 3))


def box(x: float, y: float, z: float) -> torch.Tensor:
    return torch.tensor([[0.0, 0.0, 0.0], [x, y, z]])


def test_smpl_keeps_what_is_set():
    smpl = Skeleton(SMPL_JOINT_NAMES, (-1,) + (0,) * 23, torch.zeros(24, 3), torch.zeros(24, 3))
    config = BodySkinningConfig()
    assert with_grid_sides(config, box(0.3, 1.0, 1.8), smpl) is config


def test_a_long_animal_has_its_nodes_along_its_length():
    config = with_grid_sides(BodySkinningConfig(), box(0.4, 1.2, 1.8), OTHER)
    assert config.margin_m == [0.20, 0.12, 0.12]
    sides = [0.4 + 0.4, 1.2 + 0.24, 1.8 + 0.24]
    cells = [side / count for side, count in zip(sides, config.resolution, strict=True)]
    assert max(cells) < 1.05 * min(cells)
    assert 0.9 < math.prod(config.resolution) / (64 * 64 * 16) < 1.1


def test_a_person_of_another_rig_stays_flat():
    config = with_grid_sides(BodySkinningConfig(), box(1.75, 1.7, 0.3), OTHER)
    assert config.margin_m == [0.12, 0.12, 0.20]
    assert config.resolution[0] > config.resolution[1] > 2 * config.resolution[2]


def test_a_flat_subject_keeps_some_nodes_each_way():
    config = with_grid_sides(BodySkinningConfig(margin_m=[0.0, 0.0, 0.0]), box(1.0, 1.0, 0.0), OTHER)
    assert min(config.resolution) == 4
