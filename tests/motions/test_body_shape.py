"""Gender and shape parameters in all spellings of AMASS files."""

from __future__ import annotations

import numpy as np
import pytest

from snarfcli.errors import UserError
from snarfcli.motions import read_shape

BETAS = np.linspace(-1, 1, 16)


@pytest.mark.parametrize(
    ("gender", "expected"),
    [
        (np.array("male"), "male"), (np.array(b"female"), "female"), ("neutral", "neutral"), (np.array(["Female"]), "female"),
        ("b'male'", "male"), (np.array("M"), "male"), (np.bytes_("f"), "female"), ("", "neutral"),
    ],
)  # fmt: skip
def test_spellings(tmp_path, gender, expected):
    np.savez(tmp_path / "shape.npz", gender=gender, betas=BETAS)
    found, betas = read_shape(tmp_path / "shape.npz")
    assert found == expected
    assert betas.dtype == np.float64
    np.testing.assert_array_equal(betas, BETAS)


def test_sequences_and_rows(tmp_path):
    rows = np.tile(BETAS, (3, 1)).astype(np.float32)
    np.savez(tmp_path / "a.npz", poses=np.zeros((3, 156)), betas=rows, extra=np.array([{}]))
    gender, betas = read_shape(tmp_path / "a.npz")
    assert gender == "neutral"
    assert betas.shape == (16,)
    np.testing.assert_allclose(betas, BETAS, atol=1e-7)


def test_betas_may_be_optional(tmp_path):
    np.savez(tmp_path / "a.npz", gender="f")
    gender, betas = read_shape(tmp_path / "a.npz", needs_betas=False)
    assert gender == "female"
    assert betas.shape == (0,)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"gender": "male"}, "wanted 'betas', got none; give shape.npz or a sequence"),
        ({"betas": BETAS, "gender": "man\n"}, "gender: wanted male, female or neutral, got 'man'"),
        ({"betas": np.full(10, np.nan)}, "betas: wanted at least 1 finite number"),
        ({"betas": np.zeros(0)}, "betas: wanted at least 1 finite number"),
        ({"betas": np.array("ten")}, "betas: wanted at least 1 finite number"),
        ({"betas": np.arange(20.0).reshape(2, 10)}, "equal in all rows"),
        ({"betas": BETAS, "gender": np.array(None, dtype=object)}, "never executed"),
    ],
)
def test_bad_content(tmp_path, arrays, message):
    np.savez(tmp_path / "shape.npz", **arrays)
    with pytest.raises(UserError, match=message) as caught:
        read_shape(tmp_path / "shape.npz")
    assert "shape.npz" in str(caught.value)
    assert str(caught.value).isprintable()
