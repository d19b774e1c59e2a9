"""Learned skinning weights compared with true ones."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from snarfcli.bodies import MeshTemplate
from snarfcli.evaluation.weight_metrics import compare_weights, measure_weights, weights_text

TRUE = np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 0.2, 0.8], [0.0, 0.0, 1.0]])


def test_equal_weights_are_right():
    none_wrong = {"wrong_share": 0.0, "wrong_share_p95": 0.0, "l1_norm": 0.0}
    all_right = {"right_bone": 1.0, "precision": 1.0, "recall": 1.0}
    assert compare_weights(TRUE, TRUE) == {**none_wrong, **all_right, "vertices": 4}


def test_the_share_on_wrong_bones_is_what_would_have_to_be_moved():
    learned = np.array([[0.0, 1.0, 0.0], [0.5, 0.5, 0.0], [0.0, 0.4, 0.6], [0.1, 0.0, 0.9]])
    found = compare_weights(learned, TRUE)
    assert found["wrong_share"] == pytest.approx((1.0 + 0.0 + 0.2 + 0.1) / 4)
    assert found["right_bone"] == 0.75
    assert found["l1_norm"] == pytest.approx(2 * found["wrong_share"])
    assert "4 vertices: 32.5 % on wrong bones" in weights_text(found)


def test_precision_and_recall_are_of_the_influences_of_a_vertex():
    learned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.005, 0.4, 0.595], [0.1, 0.1, 0.8]])
    found = compare_weights(learned, TRUE)
    assert found["precision"] == pytest.approx((0 + 1 + 1 + 1 / 3) / 4)  # 0.005 is no influence
    assert found["recall"] == pytest.approx((0 + 1 / 2 + 1 + 1) / 4)
    assert "precision 58.3 %, recall 62.5 %" in weights_text(found)


def test_weights_are_compared_at_the_canonical_vertices():
    vertices = np.arange(12.0).reshape(4, 3)

    def weights_at(points):
        assert torch.equal(points, torch.tensor(vertices, dtype=torch.float32))
        return torch.tensor(TRUE)

    avatar = SimpleNamespace(has_skinning_weights=True, skinning_weights=weights_at)
    template = MeshTemplate(vertices, np.zeros((0, 3), np.int32), TRUE)
    assert measure_weights(avatar, template)["wrong_share"] == 0
    assert measure_weights(avatar, None) is None
    without = SimpleNamespace(has_skinning_weights=False)
    assert measure_weights(without, template) is None
