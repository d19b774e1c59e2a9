"""Skinning weights from a file: read safely, checked in one line, kept in the avatar."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from toy_subject import LENGTH, toy_body

from snarfcli.deformer import CanonicalGrid
from snarfcli.errors import UserError
from snarfcli.models.preset import read_preset_weights

GRID = CanonicalGrid(torch.tensor([-0.2, -0.2, -0.2]), torch.tensor([2 * LENGTH + 0.2, 0.2, 0.2]))
SHAPE = (8, 8, 24)


def arrays():
    body = toy_body()
    return {"vertices": body.v_template.numpy(), "weights": body.weights.numpy()}


def test_weights_of_the_file_are_those_of_the_field(tmp_path):
    np.savez(tmp_path / "weights.npz", **arrays())
    field = read_preset_weights(tmp_path / "weights.npz", GRID, SHAPE, 2)
    wanted = torch.as_tensor(arrays()["weights"])
    error = (field(torch.as_tensor(arrays()["vertices"])) - wanted).abs().amax(1)
    assert float(error.mean()) < 0.03
    assert float(error.max()) < 0.25


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": None}, "wanted the arrays vertices and weights, got vertices$"),
        ({"weights": np.ones((5, 3))}, r"weights: wanted numbers \[V, 2\], got float64 \[5, 3\]"),
        ({"vertices": np.array([["a", "b", "c"]])}, r"vertices: wanted numbers \[V, 3\], got <U1"),
        ({"weights": np.ones((4, 2)) / 2}, r"weights: wanted shape \[\d+, J\]"),
        ({"vertices": 5 + arrays()["vertices"]}, "vertices: wanted all in the canonical box"),
        ({"weights": 2 * arrays()["weights"]}, "wanted a sum of 1"),
    ],
)
def test_a_file_that_does_not_fit_ends_in_one_line(tmp_path, changes, message):
    path = tmp_path / "weights.npz"
    np.savez(path, **{name: array for name, array in (arrays() | changes).items() if array is not None})
    with pytest.raises(UserError, match=message) as caught:
        read_preset_weights(path, GRID, SHAPE, 2)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_none_ends_in_one_line(tmp_path):
    (tmp_path / "text.npz").write_text("no archive")
    np.savez(tmp_path / "pickled.npz", vertices=np.array([{}]), weights=np.ones((1, 2)))
    for name, message in (("missing", "no weights file"), ("text", "is not an .npz archive"), ("pickled", "pickled objects")):
        with pytest.raises(UserError, match=message):
            read_preset_weights(tmp_path / f"{name}.npz", GRID, SHAPE, 2)
