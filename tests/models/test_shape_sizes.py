"""The sizes of the shape's settings follow the thickness of a subject."""

from __future__ import annotations

import pytest
import torch

from snarfcli.bodies import SMPL_JOINT_NAMES, Skeleton
from snarfcli.models.shape_sizes import with_shape_sizes
from snarfcli.shape import ShapeConfig

SHAPE = ShapeConfig(name="grid", feature_cells_m=[0.12, 0.02], prior_radius_m=0.07)
BONE = Skeleton(("a", "b"), (-1, 0), torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.zeros(2, 3))


def tube(radius: float) -> torch.Tensor:
    """Return points around the bone from x = 0 to 1, metres."""
    angle = torch.linspace(0, 6, 5000)
    return torch.stack([torch.linspace(0, 1, 5000), radius * angle.cos(), radius * angle.sin()], 1)


@pytest.mark.parametrize(("radius", "factor"), [(0.2, 1.0), (0.055, 1.0), (0.0385, 0.7), (0.001, 0.65)])
def test_thin_subjects_get_thin_capsules_and_fine_cells(radius, factor):
    shape = with_shape_sizes(SHAPE, tube(radius), BONE)
    assert shape.prior_radius_m == pytest.approx(factor * 0.07, rel=1e-3)
    assert shape.feature_cells_m == pytest.approx([factor * 0.12, factor * 0.02], rel=1e-3)
    assert with_shape_sizes(ShapeConfig(), tube(radius), BONE).prior_radius_m is None


def test_smpl_keeps_what_is_set():
    smpl = Skeleton(SMPL_JOINT_NAMES, (-1,) + (0,) * 23, torch.zeros(24, 3), torch.zeros(24, 3))
    assert with_shape_sizes(SHAPE, tube(0.01), smpl) is SHAPE
