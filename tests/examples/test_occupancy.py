"""The example with a small field: it learns shape and weights of an arm, also for poses that it has not seen."""

from __future__ import annotations

import occupancy
import torch


def test_shape_and_weights_are_learned():
    (before, _), *_, (learned, further) = occupancy.train(steps=60)
    assert before < 0.7
    assert learned > 0.85
    assert further > 0.85  # bent twice as far as in training


def test_the_known_arm_is_a_capsule_where_it_is_straight():
    points = torch.tensor([[[0.5, 0.09, 0], [0.5, 0.11, 0], [1.09, 0, 0], [1.11, 0, 0], [-0.05, 0.05, 0], [0.2, 0.08, 0.08]]])
    assert occupancy.KnownArm()(points, occupancy.bent(torch.zeros(1))).tolist() == [[1, 0, 1, 0, 1, 0]]


def test_the_elbow_turns_the_second_bone():
    transforms = occupancy.bent(torch.tensor([torch.pi / 2]))[0, 1]
    assert (transforms @ torch.tensor([0.5, 0, 0, 1])).allclose(torch.tensor([0.5, 0, 0, 1]), atol=1e-6)
    assert (transforms @ torch.tensor([1.0, 0, 0, 1])).allclose(torch.tensor([0.5, 0.5, 0, 1]), atol=1e-6)
