"""Pairs of queries and boxes against all pairs."""

from __future__ import annotations

import pytest
import torch

from snarfcli.deformer import candidates
from snarfcli.deformer.candidates import pairs_in_boxes


def boxes_and_points(poses: int, count: int, boxes: int, largest: float):
    generator = torch.Generator().manual_seed(0)
    points, lower = (torch.randn(3, poses * n, generator=generator) for n in (count, boxes))
    return points, lower, lower + largest * torch.rand(3, poses * boxes, generator=generator)


def all_pairs(points, lower, upper, poses):
    pose, box_pose = (torch.arange(poses).repeat_interleave(values.shape[1] // poses) for values in (points, lower))
    inside = ((points[:, None] >= lower[..., None]) & (points[:, None] <= upper[..., None])).all(0)
    box, query = (inside & (pose == box_pose[:, None])).nonzero(as_tuple=True)
    return set(zip(query.tolist(), box.tolist(), strict=True))


def found_pairs(*arguments):
    parts = list(pairs_in_boxes(*arguments))
    for _, box in parts:
        assert bool((box.diff() >= 0).all())
    pairs = [pair for query, box in parts for pair in zip(query.tolist(), box.tolist(), strict=True)]
    assert len(pairs) == len(set(pairs))
    return set(pairs)


@pytest.mark.parametrize("at_once", [2_000_000, 50])
@pytest.mark.parametrize(("poses", "count", "boxes", "largest"), [(1, 500, 80, 0.9), (3, 100, 50, 2.0), (40, 3, 4, 3.0)])
def test_all_pairs_are_found_once(monkeypatch, poses, count, boxes, largest, at_once):
    monkeypatch.setattr(candidates, "_PAIRS_AT_ONCE", at_once)
    arguments = *boxes_and_points(poses, count, boxes, largest), poses
    wanted = all_pairs(*arguments)
    assert found_pairs(*arguments) == wanted
    assert len(wanted) > 5


def test_what_is_no_number_or_far_away_is_in_no_pair():
    points, lower, upper = boxes_and_points(1, 60, 30, 1.0)
    wanted = all_pairs(points, lower, upper, 1)
    odd = torch.tensor([torch.nan, torch.inf, -torch.inf, 1e30, -1e30])
    junk = torch.cartesian_prod(odd, torch.cat([odd, torch.zeros(1)]), torch.cat([odd, torch.ones(1)])).T
    assert found_pairs(torch.cat([points, junk], 1), lower, upper, 1) == wanted
    boxes = torch.cat([lower, junk], 1), torch.cat([upper, junk.flip(1)], 1)
    assert found_pairs(points, *boxes, 1) == wanted
    assert found_pairs(junk, junk, junk, 1) == set()


def test_boxes_beside_the_queries_hold_none():
    points = torch.tensor([[0.0, 1.0], [0.0, 1.0], [0.0, 1.0]])
    corners = torch.tensor([[-2.0, 2.0], [-2.0, 2.0], [0.5, 0.5]])
    assert found_pairs(points, corners, corners + 0.1, 1) == set()
