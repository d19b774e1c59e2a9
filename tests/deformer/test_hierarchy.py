"""The softmax down the tree of joints, against a walk through the tree that is written out."""

from __future__ import annotations

import math

import pytest
import torch

from snarfcli.deformer.hierarchy import HierarchicalSoftmax, PlainSoftmax, make_softmax

SMPL = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]
TREES = {
    "one": [-1],
    "pair": [-1, 0],
    "chain": [-1, 0, 1, 2, 3, 4, 5, 6],
    "star": [-1, 0, 0, 0],
    "roots": [-1, -1, 0, 1, 1],
    "shuffled": [4, 0, -1, 0, 2, -3, 5, 1],
    "smpl": SMPL,
}


def walk(parents, logits):
    """Return the weights of one point as the chances of a walk down the tree, number by number."""
    siblings = [[k for k, p in enumerate(parents) if max(p, -1) == max(parent, -1)] for parent in parents]
    children = [[k for k, p in enumerate(parents) if p == joint] for joint in range(len(parents))]
    contested = [joint for joint in range(len(parents)) if len(siblings[joint]) > 1]
    inner = [joint for joint in range(len(parents)) if children[joint]]
    against = dict(zip(contested, logits, strict=False))
    stopping = dict(zip(inner, logits[len(contested) :], strict=True))
    chance = {}

    def reached(joint):
        if joint not in chance:
            parent = parents[joint]
            before = 1.0 if parent < 0 else reached(parent) / (1 + math.exp(stopping[parent]))
            if joint in against:
                before *= math.exp(against[joint]) / sum(math.exp(against[k]) for k in siblings[joint])
            chance[joint] = before
        return chance[joint]

    return [reached(j) * (1 / (1 + math.exp(-stopping[j])) if j in stopping else 1.0) for j in range(len(parents))]


@pytest.mark.parametrize("parents", TREES.values(), ids=TREES.keys())
def test_weights_are_the_chances_of_the_walk(parents):
    softmax = HierarchicalSoftmax(parents)
    logits = 3 * torch.randn(4, softmax.num_logits, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    wanted = torch.tensor([walk(parents, row) for row in logits.tolist()], dtype=torch.float64)
    torch.testing.assert_close(softmax(logits), wanted, atol=1e-14, rtol=1e-12)
    torch.testing.assert_close(softmax(logits).sum(-1), torch.ones(4, dtype=torch.float64))


def test_smpl_needs_25_logits():
    assert HierarchicalSoftmax(SMPL).num_logits == 25
    assert PlainSoftmax(24).num_logits == 24


@pytest.mark.parametrize("parents", TREES.values(), ids=TREES.keys())
def test_any_weights_can_be_reached(parents):
    softmax = HierarchicalSoftmax(parents)
    scores = 20 * torch.randn(5, len(parents), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.testing.assert_close(softmax(softmax.invert(scores)), scores.softmax(-1))


def test_a_weight_of_zero_can_be_reached():
    softmax = HierarchicalSoftmax(SMPL)
    scores = torch.full((1, 24), -torch.inf)
    scores[0, 5] = 0
    torch.testing.assert_close(softmax(softmax.invert(scores)), scores.exp())


@pytest.mark.parametrize("scale", [1e2, 1e4, 1e30])
def test_large_logits_neither_overflow_nor_lose_their_gradients(scale):
    softmax = HierarchicalSoftmax(TREES["chain"] + [0, 0, 1])
    logits = scale * torch.randn(50, softmax.num_logits, generator=torch.Generator().manual_seed(2))
    logits.requires_grad_()
    weights = softmax(logits)
    assert bool((weights >= 0).all())
    torch.testing.assert_close(weights.sum(-1), torch.ones(50))
    weights.square().sum().backward()
    assert bool(logits.grad.isfinite().all())


def test_gradcheck():
    softmax = HierarchicalSoftmax(TREES["shuffled"])
    logits = torch.randn(3, softmax.num_logits, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    assert torch.autograd.gradcheck(softmax, logits.requires_grad_())


def test_branches_compete_only_where_they_part():
    """Of two legs below a trunk, one's inner share does not move the other's inner share."""
    parents = [-1, 0, 0, 1, 2]
    softmax = HierarchicalSoftmax(parents)
    logits = torch.zeros(1, softmax.num_logits, dtype=torch.float64)
    inner = softmax.num_logits - 3  # the logits for stopping at joints 0, 1 and 2 come last
    moved = logits.clone()
    moved[0, inner + 1] = 2.0
    before, after = softmax(logits)[0], softmax(moved)[0]
    torch.testing.assert_close(before[[0, 2, 4]], after[[0, 2, 4]])
    assert after[1] > before[1]
    assert after[3] < before[3]


@pytest.mark.parametrize(
    ("parents", "message"),
    [
        ([], "at least one joint"),
        ([0], "cycle at or above joint 0"),
        ([-1, 2, 1], "cycle at or above joint 1"),
        ([-1, 5], "wanted numbers below 2, got 5"),
    ],
)
def test_what_is_no_tree_is_rejected(parents, message):
    with pytest.raises(ValueError, match=message):
        HierarchicalSoftmax(parents)


def test_choices_are_named():
    assert isinstance(make_softmax("plain", 3), PlainSoftmax)
    with pytest.raises(ValueError, match=r"skinning.softmax: wanted plain or hierarchical, got 'soft'"):
        make_softmax("soft", 3)
    with pytest.raises(ValueError, match="parents: wanted the parent of each bone"):
        make_softmax("hierarchical", 3)
    with pytest.raises(ValueError, match="each of the 3 bones, got 2"):
        make_softmax("hierarchical", 3, [-1, 0])
