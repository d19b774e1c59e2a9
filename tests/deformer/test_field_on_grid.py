"""Weights at points as the search sees them, few nodes for few points, and grids that are kept."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from skinning_scenes import random_transforms, unit_grid
from torch import nn

from snarfcli.deformer import (
    BonePrior,
    CanonicalGrid,
    ForwardDeformer,
    NodeWeights,
    PresetWeights,
    SearchConfig,
    SkinningConfig,
)

SHAPE = (6, 7, 8)
NODES = math.prod(SHAPE)


class Counted(nn.Module):
    """A field that knows how many points it was asked for."""

    def __init__(self, dtype=torch.float32) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layer = nn.Linear(3, 3, dtype=dtype)
        self.asked: list[int] = []

    def forward(self, x):
        self.asked.append(len(x))
        return (4 * self.layer(x).sin()).softmax(1)


def make(name: str, dtype=torch.float32, field=None, prior=None) -> ForwardDeformer:
    torch.manual_seed(0)
    skinning = SkinningConfig(name, resolution=[8, 7, 6], width=16, depth=2)
    search = SearchConfig("broyden") if name == "mlp" else None
    if name == "preset":
        field = PresetWeights(unit_grid(dtype), torch.rand(*SHAPE, 3).softmax(-1).to(dtype))
    made = ForwardDeformer(unit_grid(dtype), 3, skinning, search, field=field, prior=prior).to(dtype)
    if name == "voxel":
        nn.init.normal_(made.field.logits, 0, 0.1)
    return made


def points(count: int, dtype=torch.float32) -> torch.Tensor:
    return 2.4 * torch.rand(count, 3, generator=torch.Generator().manual_seed(1)).to(dtype) - 1.2


@pytest.mark.parametrize("name", ["distilled", "voxel", "preset"])
def test_few_points_have_the_weights_of_the_whole_grid(name):
    """Inside and outside the box, whether the field, its grid or a frozen grid is asked, with and without gradients."""
    deformer = make(name, torch.float64)
    x = points(20, torch.float64)
    wanted = NodeWeights(deformer.weight_grid().detach(), deformer.grid).at(x)
    for weights in (None, deformer.node_weights()):
        torch.testing.assert_close(deformer.skinning_weights(x, weights), wanted)
        with torch.no_grad():
            torch.testing.assert_close(deformer.skinning_weights(x, weights), wanted)
    torch.testing.assert_close(deformer.skinning_weights(points(300, torch.float64))[:20], deformer.skinning_weights(x))
    torch.testing.assert_close(deformer.freeze().skinning_weights(x), wanted)
    assert deformer.skinning_weights(x[:0]).shape == (0, 3)


@pytest.mark.parametrize("frozen", [False, True])
@pytest.mark.parametrize("gradients", [False, True])
@pytest.mark.parametrize("name", ["distilled", "voxel", "preset", "mlp"])
def test_points_of_any_leading_shape(name, gradients, frozen):
    deformer = make(name)
    if frozen and name != "mlp":
        deformer.freeze()
    x = points(30)
    with torch.set_grad_enabled(gradients):
        flat = deformer.skinning_weights(x)
        torch.testing.assert_close(deformer.skinning_weights(x.reshape(2, 3, 5, 3)), flat.reshape(2, 3, 5, 3))
        torch.testing.assert_close(deformer.skinning_weights(x[0]), flat[0])


def test_points_of_any_leading_shape_with_weights_of_each_pose():
    def field(x, pose_index):
        return (x * (1 + pose_index[:, None])).softmax(1)

    deformer = make("distilled", field=field)
    x, pose = points(30), torch.arange(30) % 3
    flat = deformer.skinning_weights(x, pose_index=pose)
    shaped = deformer.skinning_weights(x.reshape(2, 15, 3), pose_index=pose.reshape(2, 15))
    torch.testing.assert_close(shaped.reshape(30, 3), flat)


def test_points_and_poses_that_do_not_fit_are_named():
    deformer = make("voxel")
    with pytest.raises(ValueError, match=r"canonical: wanted shape \[\.\.\., 3\], got \[5, 2\]"):
        deformer.skinning_weights(points(5)[:, :2])
    with pytest.raises(ValueError, match=r"pose_index: wanted shape \[5\] to fit canonical, got \[4\]"):
        deformer.skinning_weights(points(5), pose_index=torch.zeros(4, dtype=torch.long))
    with pytest.raises(ValueError, match=r"canonical: wanted shape \[N, 3\], got \[1, 5, 3\]"):
        deformer.node_weights().at(points(5)[None])


def test_only_nodes_around_the_points_are_evaluated():
    field = Counted()
    deformer = make("distilled", field=field)
    deformer.skinning_weights(points(1))
    deformer.skin(points(2), random_transforms(1, 3, 0.3, dtype=torch.float32)[0])
    assert field.asked[0] == 8
    assert field.asked[1] <= 16
    deformer.skinning_weights(points(NODES))
    assert field.asked[2] == NODES


def test_the_prior_at_the_nodes_is_kept_beside_other_queries():
    """A step of training evaluates the nodes and other points; the distances to the bones are found once."""
    prior = BonePrior(torch.rand(3, 2, 3), [0, 1, 2], 3, 0.1)
    deformer, asked = make("distilled", prior=prior), []
    prior.register_forward_hook(lambda module, inputs, output: asked.append(len(output)))
    for _ in range(3):
        deformer.node_weights(active_only=True)
        deformer.skinning_weights(points(1))
    assert asked == [NODES, 8, 8, 8]


@pytest.mark.parametrize("name", ["distilled", "mlp"])
def test_gradcheck_of_weights_at_points(name):
    field = Counted(torch.float64)
    deformer = make(name, torch.float64, field)
    x = (0.5 * points(4, torch.float64)).requires_grad_()

    def weights(x, *parameters):
        return deformer.skinning_weights(x)

    torch.autograd.gradcheck(weights, (x, *field.parameters()))


@pytest.mark.parametrize("name", ["distilled", "voxel", "preset", "mlp"])
def test_weights_and_skinning_are_exact_under_autocast(name):
    deformer = make(name)
    transforms, x = random_transforms(2, 3, 0.5, dtype=torch.float32), points(50).expand(2, -1, -1)
    wanted = deformer.skinning_weights(x[0]), deformer.skin(x, transforms), deformer(x, transforms).canonical
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(deformer.skinning_weights(x[0]), wanted[0])
        assert torch.equal(deformer.skin(x, transforms), wanted[1])
        assert torch.equal(deformer(x, transforms).canonical, wanted[2])
        assert deformer.skinning_weights(x[0].bfloat16()).dtype == torch.float32
        deformer.freeze()
        torch.testing.assert_close(deformer.skinning_weights(x[0]), wanted[0], rtol=0, atol=1e-5)


def test_smoothness_of_weights_that_differ_from_pose_to_pose():
    deformer = make("distilled", field=Counted())
    one, other = (torch.rand(*SHAPE, 3).softmax(-1) for _ in range(2))
    alone = [deformer.smoothness(NodeWeights(values, deformer.grid)) for values in (one, other)]
    both = deformer.smoothness(NodeWeights(torch.stack([one, other]), deformer.grid))
    torch.testing.assert_close(both, (alone[0] + alone[1]) / 2)


# ---------------------------------------------------------------- frozen grids
def test_a_frozen_grid_survives_what_does_not_change_it():
    """Evaluation is switched on before every validation, also of an outer module; moves take the grid along."""
    deformer = make("distilled", field=Counted())
    outer = nn.ModuleList([deformer])
    grid = deformer.freeze().weight_grid()
    for _ in range(2):
        outer.eval()
        assert deformer.weight_grid() is grid
    assert copy.deepcopy(deformer).weight_grid().equal(grid)
    assert deformer.double().weight_grid().dtype == torch.float64
    assert len(deformer.field.asked) == 1
    assert "_frozen" not in deformer.state_dict()


def test_training_discards_a_frozen_grid_only_if_there_is_something_to_train():
    deformer = make("distilled")
    deformer.freeze()
    deformer.train()
    assert deformer.weight_grid().requires_grad
    deformer.requires_grad_(False)
    kept = deformer.freeze().weight_grid()
    nn.ModuleList([deformer]).train()
    assert deformer.weight_grid() is kept
    preset = make("preset")
    kept = preset.freeze().weight_grid()
    assert preset.train().weight_grid() is kept
    function = make("distilled", field=lambda x: x.softmax(1))
    kept = function.freeze().weight_grid()
    assert function.train().weight_grid() is not kept


def test_loading_a_state_discards_a_frozen_grid():
    deformer, other = make("distilled"), make("distilled")
    nn.init.normal_(other.field.layers[-1].bias)
    before = deformer.freeze().weight_grid()
    deformer.load_state_dict(other.state_dict())
    assert not torch.allclose(deformer.weight_grid(), before)
    torch.testing.assert_close(deformer.weight_grid(), other.weight_grid())


def test_settings_that_a_deformer_does_not_use_are_refused():
    for name in ("margin_m", "bone_radius_m", "prior_falloff_m", "smoothness", "symmetric", "weights_file"):
        with pytest.raises(TypeError, match=name):
            SkinningConfig(**{name: None})


def test_a_field_at_grid_nodes_brings_its_settings():
    preset = PresetWeights(unit_grid(torch.float32), torch.rand(*SHAPE, 3).softmax(-1))
    deformer = ForwardDeformer(unit_grid(torch.float32), 3, field=preset)
    assert deformer.shape == SHAPE
    assert torch.equal(deformer.weight_grid().reshape(-1, 3), preset.weights)


def test_what_is_no_tensor_or_does_not_fit_is_named():
    deformer, transforms = make("distilled"), random_transforms(2, 3, 0.3, dtype=torch.float32)
    cells = torch.ones(2, 2, 2, dtype=torch.bool)
    for call, error, message in [
        (lambda: CanonicalGrid([0, 0, 0], [1, 1, 1]), TypeError, r"grid.lower: wanted a tensor \[3\], got a list"),
        (lambda: CanonicalGrid.around(points(5), [0.1]), ValueError, r"points, margin: wanted shapes"),
        (lambda: ForwardDeformer(unit_grid(), 0), ValueError, "num_bones: wanted at least 1, got 0"),
        (lambda: deformer(points(5)[None].numpy(), transforms[:1]), TypeError, "points: wanted a tensor in .*, got a ndarray"),
        (lambda: deformer.pose(transforms.numpy()), TypeError, "bone_transforms: wanted a tensor, got a ndarray"),
        (lambda: deformer.posed_box(transforms[0], cells), ValueError, r"cells: wanted bool \[5, 6, 7\]"),
        (lambda: deformer.set_active_cells(cells), ValueError, r"active_cells: wanted bool \[5, 6, 7\]"),
    ]:
        with pytest.raises(error, match=message):
            call()
