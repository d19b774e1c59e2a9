"""The module with each weight field: search and skinning undo each other, states are whole, cells can be chosen."""

from __future__ import annotations

import copy

import pytest
import torch
from skinning_scenes import random_transforms, unit_grid
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from snarfcli.deformer import (
    CanonicalGrid,
    ForwardDeformer,
    PresetWeights,
    SearchConfig,
    SkinningConfig,
    centring,
    correspondences,
    field_on_grid,
    find_correspondences,
    grid_search,
    posed,
)
from snarfcli.deformer.skinning_config import FIELDS

PARENTS = [-1, 0, 1]
BONES = 3
SHAPE = (6, 7, 8)


def settings(name: str, **changes) -> SkinningConfig:
    return SkinningConfig(name=name, resolution=[8, 7, 6], width=16, depth=2, weight_norm=False, **changes)


def preset(grid: CanonicalGrid) -> PresetWeights:
    points = unit_grid(torch.float32).nodes((3, 3, 12)).reshape(-1, 3)
    scores = torch.stack([-((points[:, 0] - c) ** 2) for c in (-0.5, 0.0, 0.5)], 1)
    return PresetWeights.from_vertices(points, (4 * scores).softmax(1), grid, SHAPE)


def deformer(name: str, grid: CanonicalGrid | None = None, softmax: str = "plain", seed: int = 0) -> ForwardDeformer:
    torch.manual_seed(seed)
    grid = grid or unit_grid(torch.float32)
    field = preset(unit_grid(torch.float32)) if name == "preset" else None
    search = SearchConfig("broyden", max_steps=50, divergence=5.0) if name == "mlp" else None
    made = ForwardDeformer(grid, BONES, settings(name, softmax=softmax), search, parents=PARENTS, field=field)
    if name == "voxel":
        smooth = torch.linspace(-1, 1, SHAPE[2]).repeat(SHAPE[0] * SHAPE[1])
        with torch.no_grad():
            made.field.logits[:, 0] = 0.1 * smooth
            made.field.logits[:, -1] = -0.05 * smooth
    return made


def canonical_points(count: int = 60) -> torch.Tensor:
    return 1.4 * torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) - 0.7


@pytest.mark.parametrize("softmax", ["plain", "hierarchical"])
@pytest.mark.parametrize("name", FIELDS)
def test_the_search_undoes_skinning(name, softmax):
    module = deformer(name, softmax=softmax)
    transforms = random_transforms(1, BONES, 0.3, dtype=torch.float32)
    canonical = canonical_points()
    with torch.no_grad():
        posed = module.skin(canonical, transforms[0])
        found = module(posed[None], transforms)
        weights = module.skinning_weights(canonical)
    assert bool((weights >= 0).all())
    torch.testing.assert_close(weights.sum(1), torch.ones(len(canonical)))
    for query, point in enumerate(canonical):
        distances = (found.canonical[found.query == query] - point).norm(dim=1)
        assert len(distances)
        assert float(distances.min()) < 1e-4


@pytest.mark.parametrize("name", FIELDS)
def test_a_state_is_whole(name, tmp_path):
    """Saved and loaded into a module that was made with another box and other cells."""
    module = deformer(name)
    cells = torch.ones(5, 6, 7, dtype=torch.bool)
    cells[0] = False
    module.set_active_cells(cells)
    torch.save(module.state_dict(), tmp_path / "state.pt")
    other = deformer(name, CanonicalGrid(torch.full((3,), -3.0), torch.full((3,), 3.0)), seed=1)
    other.freeze()
    other.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert torch.equal(other.active_cells, cells)
    assert torch.equal(other.lower, module.lower)
    with torch.no_grad():
        assert torch.equal(other.weight_grid(), module.weight_grid())
        assert torch.equal(other.skinning_weights(canonical_points()), module.skinning_weights(canonical_points()))


@pytest.mark.parametrize("name", FIELDS)
def test_gradients_reach_the_parameters(name):
    module = deformer(name)
    transforms = random_transforms(2, BONES, 0.3, dtype=torch.float32)
    points = (0.5 * torch.rand(2, 30, 3, generator=torch.Generator().manual_seed(2))).requires_grad_()
    found = module(points, transforms)
    found.canonical.square().sum().backward()
    assert bool((points.grad != 0).any())
    for parameter in module.parameters():
        assert bool(parameter.grad.isfinite().all())
        assert bool((parameter.grad != 0).any())
    assert bool(list(module.parameters())) == (name != "preset")


@pytest.mark.parametrize("name", FIELDS)
def test_moves_to_another_dtype(name):
    module = deformer(name)
    module.double()
    transforms = random_transforms(1, BONES, 0.2)
    found = module(canonical_points(5).double()[None], transforms)
    assert found.canonical.dtype == torch.float64
    assert len(found.query) >= 5


def stripes(x):
    """A custom weight field, written as a function."""
    first = (3 * x[:, 0]).sigmoid()
    return torch.stack([first, 0.5 * (1 - first), 0.5 * (1 - first)], 1)


@pytest.mark.parametrize("name", ["distilled", "mlp"])
def test_a_function_of_the_users_own_is_the_field(name):
    module = ForwardDeformer(unit_grid(torch.float32), BONES, settings(name), field=stripes)
    assert module.search.name == ("broyden" if name == "mlp" else "complete")
    canonical = canonical_points()
    error = (module.skinning_weights(canonical) - stripes(canonical)).abs().max()
    assert float(error) < (1e-7 if name == "mlp" else 0.05)  # cells of 29 cm
    transforms = random_transforms(1, BONES, 0.2, dtype=torch.float32)
    found = module(module.skin(canonical, transforms[0])[None], transforms)
    assert bool(found.found.all())
    assert not module.state_dict().keys() - {"lower", "upper", "active_cells"}


@pytest.mark.parametrize("name", ["distilled", "mlp"])
def test_a_module_of_the_users_own_is_trained_and_saved_with_it(name):
    torch.manual_seed(0)
    own = nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, BONES), nn.Softmax(-1))
    module = ForwardDeformer(unit_grid(torch.float32), BONES, settings(name), field=own)
    assert {id(p) for p in module.parameters()} == {id(p) for p in own.parameters()}
    assert any(key.startswith("field.") for key in module.state_dict())
    transforms = random_transforms(1, BONES, 0.3, dtype=torch.float32)
    module(canonical_points(20)[None], transforms).canonical.square().sum().backward()
    assert all(bool((p.grad != 0).any()) for p in own.parameters())


def test_a_field_that_returns_something_else_is_named():
    module = ForwardDeformer(unit_grid(torch.float32), BONES, settings("distilled"), field=lambda x: x[:, :2])
    with pytest.raises(ValueError, match=r"field: wanted weights of shape \[336, 3\], got \[336, 2\]"):
        module.weight_grid()


def test_cells_that_are_not_active_have_no_roots():
    module = deformer("distilled")
    transforms = random_transforms(1, BONES, 0.1, dtype=torch.float32)
    points = canonical_points(400)[None]
    everywhere = module(points, transforms)
    cells = torch.ones(5, 6, 7, dtype=torch.bool)
    cells[:, :, :3] = False
    module.set_active_cells(cells)
    assert module.is_active(torch.tensor([[0.9, 0.0, 0.0], [-0.9, 0.0, 0.0], [1.1, 0.0, 0.0]])).tolist() == [True, False, False]
    fewer = module(points, transforms)
    kept = module.is_active(everywhere.canonical)
    assert 0 < int(kept.sum()) < len(kept)
    assert torch.equal(fewer.query, everywhere.query[kept])


@pytest.mark.parametrize("name", ["distilled", "voxel"])
def test_a_search_evaluates_only_nodes_of_active_cells(name):
    module = deformer(name)
    cells = torch.zeros(5, 6, 7, dtype=torch.bool)
    cells[2, 3, 4] = True
    module.set_active_cells(cells)
    with torch.no_grad():
        whole, some, variation = module.weight_grid(), module.weight_grid(active_only=True), float(module.smoothness())
    used = some.sum(-1) > 0
    assert int(used.sum()) == 8
    assert bool(used[2:4, 3:5, 4:6].all())
    torch.testing.assert_close(some[used], whole[used])
    around = whole[2:4, 3:5, 4:6]
    changes = [around.diff(dim=axis).abs().sum(-1).mean() / (2 / cells) for axis, cells in enumerate((5, 6, 7))]
    assert variation == pytest.approx(float(sum(changes)), rel=1e-4)


def gather_everything(found):
    """Call what can be gathered from correspondences with a fixed shape."""
    values = found.canonical[:, 0]
    found.maximum(values, -1.0), found.minimum(values, 1.0), found.blend(values, 2.0, 0.0)
    found.gather(found.jacobian_inverse, found.argmax(values), 0.0), found.argmin(values), found.padded(slots=2)
    return found.counts, found.found, found.pose, found.is_cut


class Operators(TorchDispatchMode):
    """Keeps the names of all operators that are called."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.names.append(function.name())
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize("name", ["distilled", "voxel", "preset"])
def test_a_search_with_a_capacity_waits_for_nothing(name, monkeypatch):
    """On a GPU, where values are not checked: sizes that depend on data, and numbers read from tensors, would wait."""
    for reader in (grid_search, centring, field_on_grid):
        monkeypatch.setattr(reader, "is_costly_to_read", lambda tensor: True)
    monkeypatch.setattr(posed, "choose_backend", lambda *_: "reference")  # cells are prepared on the CPU only
    monkeypatch.setattr(correspondences, "_reading_waits", lambda tensor: True)
    module, other = deformer(name), deformer(name, seed=1)
    cells = torch.ones(5, 6, 7, dtype=torch.bool)
    cells[0] = False
    module.set_active_cells(cells)
    other.load_state_dict(module.state_dict())
    transforms = random_transforms(2, BONES, 0.3, dtype=torch.float32)
    points = torch.rand(2, 30, 3, generator=torch.Generator().manual_seed(2))
    wanted = module(points, transforms)
    for one in (module, other, copy.deepcopy(other)):
        with Operators() as called:
            found = one(points, transforms, capacity=100)
            gather_everything(found)
            prepared = one.pose(transforms)
            again = prepared(points, capacity=100)
            prepared.skin(points, normals=points)
            prepared.transforms_at(points)
            one.skin(points, transforms, directions=points)
            one.skinning_weights(points[0])
        assert "snarf::complete_search" in called.names
        waiting = ("aten::nonzero", "aten::_local_scalar_dense", "aten::masked_select", "aten::unique")
        assert not [name for name in called.names if name.startswith(waiting)]
        assert torch.equal(found.canonical[: len(wanted.query)], wanted.canonical)
        assert torch.equal(again.canonical, found.canonical)


@pytest.mark.parametrize("name", FIELDS)
def test_weights_are_handed_on_from_a_search(name):
    module = deformer(name)
    transforms = random_transforms(1, BONES, 0.3, dtype=torch.float32)
    points = torch.rand(1, 30, 3, generator=torch.Generator().manual_seed(2))
    weights = module.node_weights()
    assert (weights is None) == (name == "mlp")
    found = module(points, transforms, weights=weights)
    assert torch.equal(found.canonical, module(points, transforms).canonical)
    torch.testing.assert_close(module.skinning_weights(found.canonical, weights), module.skinning_weights(found.canonical))
    if weights is not None:
        calls = []
        module.field.register_forward_hook(lambda *_: calls.append(1))
        module.skinning_weights(module(points, transforms, weights=weights).canonical, weights)
        assert not calls
        assert torch.equal(weights.at(found.canonical), module.skinning_weights(found.canonical, weights))


def test_the_name_of_a_search_stands_for_its_settings():
    module = ForwardDeformer(unit_grid(torch.float32), BONES, settings("distilled"), "broyden", field=stripes)
    assert module.search == SearchConfig("broyden")


def test_what_does_not_go_together_is_rejected():
    grid = unit_grid(torch.float32)
    with pytest.raises(ValueError, match=r"skinning.name: wanted distilled, voxel, mlp or preset, got 'grid'"):
        ForwardDeformer(grid, BONES, settings("grid"))
    with pytest.raises(ValueError, match=r"field: wanted weights .*; give PresetWeights.from_vertices"):
        ForwardDeformer(grid, BONES, settings("preset"))
    changed = settings("preset")
    changed.resolution = [9, 7, 6]
    with pytest.raises(TypeError, match="field: wanted a function of canonical points, got a str"):
        ForwardDeformer(grid, BONES, field="mlp")
    for resolution in ([4, 4], [4, 1, 4]):
        with pytest.raises(ValueError, match=r"skinning.resolution: wanted three numbers of at least 2, got \[4"):
            ForwardDeformer(grid, BONES, SkinningConfig(resolution=resolution))
    with pytest.raises(ValueError, match=r"search.name: wanted complete or broyden, got 'brodyen'"):
        ForwardDeformer(grid, BONES, search="brodyen")
    with pytest.raises(ValueError, match=r"weights: wanted shape \[D, H, W, J\], got \[4, 4, 4\]"):
        PresetWeights(grid, torch.ones(4, 4, 4))
    with pytest.raises(ValueError, match=r"field: wanted the grid's nodes \[6, 7, 9\] .* got \[6, 7, 8\]"):
        ForwardDeformer(grid, BONES, changed, field=preset(grid))
    with pytest.raises(ValueError, match=r"search.name: wanted broyden for skinning.name 'mlp', got 'complete'"):
        ForwardDeformer(grid, BONES, settings("mlp"), SearchConfig("complete"))
    module = deformer("mlp")
    with pytest.raises(ValueError, match=r"search.name: wanted broyden for skinning.name 'mlp'"):
        module.search = SearchConfig("complete")
    with pytest.raises(ValueError, match=r"bone_transforms: wanted \[3, 4, 4\], one pose, got \[2, 3, 4, 4\]"):
        module.posed_box(torch.eye(4).expand(2, BONES, 4, 4), module.active_cells)
    with pytest.raises(ValueError, match=r"active_cells: wanted bool \[5, 6, 7\], got torch.float32 \[5, 6, 7\]"):
        module.set_active_cells(torch.ones(5, 6, 7))
    with pytest.raises(ValueError, match="active_cells: wanted at least one cell, got none"):
        module.set_active_cells(torch.zeros(5, 6, 7, dtype=torch.bool))


def test_the_distilled_field_is_what_the_grid_search_sees():
    module = deformer("distilled")
    transforms = random_transforms(2, BONES, 0.3, dtype=torch.float32)
    points = torch.rand(2, 50, 3, generator=torch.Generator().manual_seed(3))
    by_hand = find_correspondences(points, transforms, module.weight_grid(), module.grid)
    assert torch.equal(module(points, transforms).canonical, by_hand.canonical)
