"""What is gathered from the roots of queries, against plain loops; capacities that pad or cut, and PyTorch's transforms."""

from __future__ import annotations

import copy
import math
import pickle
import warnings

import pytest
import torch
from skinning_scenes import scene, unit_grid
from torch.utils import _pytree

from snarfcli.deformer import Correspondences, find_correspondences

QUERIES = [0, 0, 2, 3, 3, 3, 5]
BATCH, COUNT = 2, 4


def roots(queries=QUERIES, batch=BATCH, count=COUNT, extra=0, total=None, dtype=torch.float64):
    """Return correspondences with random canonical points, and `extra` rows beyond the roots as a capacity makes them."""
    query = torch.tensor(queries + [batch * count] * extra, dtype=torch.long)
    generator = torch.Generator().manual_seed(0)
    canonical = torch.randn(len(query), 3, generator=generator, dtype=torch.float64).to(dtype)
    inverse = torch.randn(len(query), 3, 3, generator=generator, dtype=torch.float64).to(dtype)
    known = (torch.arange(len(query)) < len(queries))[:, None]
    total = torch.tensor([len(queries) if total is None else total])
    return Correspondences(canonical * known, query, inverse * known[..., None], batch, count, total)


def values_of(found, seed=1):
    return torch.randn(len(found.query), dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def per_query(found, values, choose, empty):
    """Return `choose` of the values of each query's roots, by a loop over the queries."""
    chosen = []
    for query in range(found.batch * found.count):
        own = values[found.query == query]
        chosen.append(choose(own) if len(own) else torch.tensor(empty, dtype=values.dtype))
    return torch.stack(chosen).reshape(found.batch, found.count) if chosen else values.new_empty(found.batch, found.count)


@pytest.mark.parametrize("extra", [0, 3])
def test_reductions_are_those_of_a_loop(extra):
    found = roots(extra=extra)
    values = values_of(found)
    assert torch.equal(found.maximum(values, -9.0), per_query(found, values, torch.amax, -9.0))
    assert torch.equal(found.minimum(values, 9.0), per_query(found, values, torch.amin, 9.0))
    mean = per_query(found, values, lambda own: (torch.softmax(3 * own, 0) * own).sum(), -5.0)
    torch.testing.assert_close(found.blend(values, 3.0, -5.0), mean, rtol=1e-14, atol=0)
    counts = [[QUERIES.count(b * COUNT + n) for n in range(COUNT)] for b in range(BATCH)]
    assert found.counts.tolist() == counts
    assert torch.equal(found.found, found.counts > 0)
    assert found.pose[: len(QUERIES)].tolist() == [query // COUNT for query in QUERIES]
    assert not found.is_cut
    assert found.is_cut.shape == ()


@pytest.mark.parametrize("extra", [0, 3])
def test_the_winning_root_gives_everything_that_belongs_to_it(extra):
    found = roots(extra=extra)
    values = values_of(found)
    for winners, choose in ((found.argmax(values), torch.argmax), (found.argmin(values), torch.argmin)):
        assert winners.dtype == torch.long
        for query, row in enumerate(winners.reshape(-1).tolist()):
            own = (found.query == query).nonzero()[:, 0]
            assert row == (int(own[choose(values[own])]) if len(own) else -1)
        for per_root in (values, found.canonical, found.jacobian_inverse, found.query, values > 0):
            gathered = found.gather(per_root, winners, 0)
            assert gathered.shape == (BATCH, COUNT, *per_root.shape[1:])
            assert gathered.dtype == per_root.dtype
            assert torch.equal(gathered[winners >= 0], per_root[winners[winners >= 0]])
            assert not gathered[winners < 0].any()
    assert torch.equal(found.gather(values, found.argmax(values), -9.0), found.maximum(values, -9.0))


def test_the_first_of_equal_values_wins_and_they_share_the_gradient():
    found = roots([1, 1, 1], 1, 2)
    values = torch.tensor([2.0, 3.0, 3.0], requires_grad=True)
    assert found.argmax(values).tolist() == [[-1, 1]]
    assert found.argmin(torch.ones(3)).tolist() == [[-1, 0]]
    assert found.argmax(torch.full((3,), -math.inf)).tolist() == [[-1, 0]]
    assert found.argmax(torch.tensor([5, 7, 6])).tolist() == [[-1, 1]]
    (gradient,) = torch.autograd.grad(found.maximum(values, 0.0).sum(), values)
    assert gradient.tolist() == [0.0, 0.5, 0.5]


def test_nan_wins_as_in_pytorch():
    found = roots([0, 0, 0, 1], 1, 2)
    values = torch.tensor([1.0, math.nan, 2.0, 3.0])
    assert int(torch.argmax(values[:3])) == int(torch.argmin(values[:3])) == 1
    assert found.argmax(values).tolist() == found.argmin(values).tolist() == [[1, 3]]
    for result in (found.maximum(values, 0.0), found.minimum(values, 0.0), found.blend(values, 2.0, 0.0)):
        assert result.isnan().tolist() == [[True, False]]
        assert float(result[0, 1]) == 3.0


@pytest.mark.parametrize("extra", [0, 3])
@pytest.mark.parametrize("slots", [None, 1, 2, 5])
def test_padded_puts_roots_side_by_side(slots, extra):
    found = roots(extra=extra)
    for values in (None, values_of(found), found.jacobian_inverse, found.query):
        filled, mask = found.padded(values, slots)
        per_root = found.canonical if values is None else values
        width = 3 if slots is None else slots
        assert filled.shape == (BATCH, COUNT, width, *per_root.shape[1:])
        assert filled.dtype == per_root.dtype
        for query in range(BATCH * COUNT):
            own = per_root[found.query == query][:width]
            b, n = divmod(query, COUNT)
            assert mask[b, n].tolist() == [slot < len(own) for slot in range(width)]
            assert torch.equal(filled[b, n, : len(own)], own)
            assert not filled[b, n, len(own) :].any()


def gathered(found):
    """Return all functions of values [M] with a gradient."""
    rows = found.argmax(values_of(found, 2))
    return {
        "maximum": lambda x: found.maximum(x, -1.0),
        "minimum": lambda x: found.minimum(x, 1.0),
        "blend": lambda x: found.blend(x, 2.0, 0.5),
        "gather": lambda x: found.gather(x, rows, 0.0),
        "padded": lambda x: found.padded(x)[0],
        "two slots": lambda x: found.padded(x, 2)[0],
    }


@pytest.mark.parametrize("name", gathered(roots()))
@pytest.mark.parametrize("extra", [0, 2])
def test_gradients(name, extra):
    found = roots(extra=extra)
    values = values_of(found)
    values[len(QUERIES) :] = math.nan  # what a network returns for the zeros beyond the roots must not matter
    values.requires_grad_()
    function = gathered(found)[name]
    (gradient,) = torch.autograd.grad(function(values).sin().sum(), values)
    assert not gradient[len(QUERIES) :].any()
    assert bool(gradient[: len(QUERIES)].any())

    def of_known(known):
        return function(torch.cat([known, torch.zeros(extra, dtype=known.dtype)]))

    assert torch.autograd.gradcheck(of_known, values.detach()[: len(QUERIES)].requires_grad_())


@pytest.mark.parametrize(("batch", "count"), [(0, 5), (2, 0), (0, 0), (2, 3)])
@pytest.mark.parametrize("extra", [0, 4])
def test_nothing_found(batch, count, extra):
    found = roots([], batch, count, extra)
    values = torch.ones(extra, dtype=torch.float64, requires_grad=True)
    for name, function in gathered(found).items():
        result = function(values)
        assert result.shape[:2] == (batch, count), name
        assert not torch.autograd.grad(result.sum(), values)[0].any()
    assert found.padded()[1].shape == (batch, count, 1)
    assert found.padded(found.jacobian_inverse, 3)[0].shape == (batch, count, 3, 3, 3)
    assert torch.equal(found.argmax(values), torch.full((batch, count), -1))
    assert not found.counts.any()
    assert not found.found.any()
    assert found.pose.shape == (extra,)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_blended_in_float32(dtype):
    found = roots()
    values = values_of(found).to(dtype)
    with torch.autocast("cpu", torch.bfloat16):
        result = found.blend(values, 20.0, 0.0)
    assert result.dtype == dtype
    assert torch.equal(result, found.blend(values.float(), 20.0, 0.0).to(dtype))


METHODS = {
    "counts": lambda found: found.counts,
    "found": lambda found: found.found,
    "maximum": lambda found: found.maximum(found.canonical[:, 0], 0.0),
    "minimum": lambda found: found.minimum(found.canonical[:, 0], 0.0),
    "argmax": lambda found: found.argmax(found.canonical[:, 0]),
    "argmin": lambda found: found.argmin(found.canonical[:, 0]),
    "blend": lambda found: found.blend(found.canonical[:, 0], 1.0, 0.0),
    "gather": lambda found: found.gather(found.canonical, torch.full((BATCH, COUNT), -1), 0.0),
    "padded": lambda found: found.padded(),
    "slots": lambda found: found.padded(slots=2),
}


@pytest.mark.parametrize("name", METHODS)
def test_a_capacity_that_cut_roots_is_reported_once(name):
    found = roots(total=9)
    assert bool(found.is_cut)
    with pytest.warns(UserWarning, match="capacity: wanted at least 9 for all roots, got 7; the others are left out") as caught:
        METHODS[name](found)
    assert [one.filename for one in caught] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for method in METHODS.values():
            method(found)
            method(roots(extra=3))


def test_on_a_gpu_only_methods_that_wait_report_a_cut(monkeypatch):
    monkeypatch.setattr("snarfcli.deformer.correspondences._reading_waits", lambda tensor: True)
    found = roots(total=9)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name, method in METHODS.items():
            if name != "padded":
                method(found)
    with pytest.warns(UserWarning, match="capacity: wanted at least 9"):
        found.padded()


WRONG = {
    "maximum": (lambda f, x: f.maximum(x, 0.0), r"values: wanted shape \[7\], one per root, got \[6\]"),
    "argmin": (lambda f, x: f.argmin(x), r"values: wanted shape \[7\], one per root, got \[6\]"),
    "blend": (lambda f, x: f.blend(f.canonical, 1.0, 0.0), r"values: wanted shape \[7\], one per root, got \[7, 3\]"),
    "gather": (lambda f, x: f.gather(x, f.argmax(x[0].expand(7)), 0.0), r"values: wanted shape \[7, ...\], .*, got \[6\]"),
    "padded": (lambda f, x: f.padded(x[0]), r"values: wanted shape \[7, ...\], one per root, got \[\]"),
    "slots": (lambda f, x: f.padded(slots=0), "slots: wanted at least 1, got 0"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_values_are_named(name):
    call, message = WRONG[name]
    with pytest.raises(ValueError, match=message) as caught:
        call(roots(), torch.zeros(6))
    assert "\n" not in str(caught.value)


def test_it_is_a_pytree():
    found = roots(extra=2)
    leaves, structure = _pytree.tree_flatten(found)
    assert [leaf.shape for leaf in leaves] == [(9, 3), (9,), (9, 3, 3), (1,)]
    again = _pytree.tree_unflatten(leaves, structure)
    assert (again.batch, again.count) == (BATCH, COUNT)
    assert again.canonical is found.canonical
    assert again.total is found.total
    paths = [_pytree.keystr(path) for path, _ in _pytree.tree_flatten_with_path(found)[0]]
    assert paths == [".canonical", ".query", ".jacobian_inverse", ".total"]
    assert _pytree.treespec_loads(_pytree.treespec_dumps(structure)) == structure
    halved = _pytree.tree_map(lambda leaf: leaf.half() if leaf.is_floating_point() else leaf, found)
    assert halved.canonical.dtype == torch.float16
    assert torch.equal(halved.counts, found.counts)


def test_several_searches_at_once_under_vmap():
    """A cut cannot be reported in there: values cannot be read."""
    several = [roots(extra=2), roots([1, 1, 1, 4, 6, 6, 7], extra=2), roots([*QUERIES, 6, 7], total=12)]
    stacked = _pytree.tree_map(lambda *leaves: torch.stack(leaves), *several)

    def gather(found, values):
        padded, mask = found.padded(values, 2)
        best = found.gather(found.canonical, found.argmax(values), 0.0)
        return padded, mask, best, found.maximum(values, -1.0), found.blend(values, 2.0, 0.0), found.counts, found.found

    values = torch.stack([values_of(found, seed) for seed, found in enumerate(several)])
    together = torch.vmap(gather)(stacked, values)
    for index, found in enumerate(several):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            alone = gather(found, values[index])
        for one, all_of_them in zip(alone, together, strict=True):
            torch.testing.assert_close(all_of_them[index], one)


class Gathering(torch.nn.Module):
    """A search and all that has a fixed shape after it; returns the correspondences too."""

    def __init__(self):
        super().__init__()
        self.grid = unit_grid()

    def forward(self, points, transforms, weights):
        found = find_correspondences(points, transforms, weights, self.grid, capacity=200)
        values = found.canonical.sum(1)
        best = found.gather(found.canonical, found.argmax(values), 0.0)
        reduced = found.maximum(values, -1.0), found.minimum(values, 1.0), found.blend(values, 2.0, 0.0)
        return found, best, reduced, found.padded(slots=2), found.counts, found.is_cut


def test_gathering_compiles_and_is_exported():
    points, transforms, weights = scene(torch.float64, count=8)
    module = Gathering()
    wanted = _pytree.tree_leaves(module(points, transforms, weights))
    compiled = torch.compile(module, fullgraph=True, backend="aot_eager")(points, transforms, weights)
    exported = torch.export.export(module, (points, transforms, weights)).module()(points, transforms, weights)
    for result in (compiled, exported):
        assert isinstance(result[0], Correspondences)
        for one, other in zip(_pytree.tree_leaves(result), wanted, strict=True):
            torch.testing.assert_close(one, other)


def test_they_can_be_copied_and_pickled():
    found = roots(total=9)
    for again in (copy.deepcopy(found), pickle.loads(pickle.dumps(found))):
        assert torch.equal(again.canonical, found.canonical)
        assert bool(again.is_cut)


def test_the_text_of_roots_is_short():
    points, transforms, weights = scene(count=40)
    found = find_correspondences(points, transforms, weights, unit_grid(torch.float32))
    assert repr(found) == f"Correspondences({len(found.query)} rows for 2 x 40 points)"
    assert found != 0
