"""Whose body a file describes: gender and shape parameters."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snarfcli.errors import UserError
from snarfcli.files import read_npz

__all__ = ["read_shape"]

log = logging.getLogger(__name__)

_GENDERS = {"male": "male", "m": "male", "female": "female", "f": "female", "neutral": "neutral", "n": "neutral", "": "neutral"}
_MOST_BETAS = 1000
_SAME = 1e-4


def read_shape(path: str | Path) -> tuple[str, NDArray[np.float64]]:
    """Read whose body an AMASS file is about: `shape.npz`, a `stagei.npz`, or any sequence.

    Args:
        path: `.npz` file with `betas` (S,), or (T, S) if all rows are the same, and `gender` in any spelling, as text or bytes.

    Returns:
        The gender, `male`, `female` or `neutral` (also where the file does not say), and all of its shape parameters [S]: 10 or
        16 in most files; SMPL's bodies take the first 10.

    Raises:
        UserError: the file is missing or damaged; it has no shape, one that changes or is not finite, or an unknown gender.
    """
    path = Path(path)
    arrays = read_npz(path, "shape file", only=("betas", "gender"), max_bytes=2**24)
    if "betas" not in arrays:
        raise UserError(f"shape file {path} has no 'betas'; give shape.npz or a sequence of the subject")
    betas = arrays["betas"]
    if betas.dtype.kind not in "fiu" or not betas.size or not np.isfinite(betas).all():
        raise UserError(f"shape file {path}: betas must hold finite numbers, one or more")
    betas = betas.astype(np.float64).reshape(-1, betas.shape[-1] if betas.ndim else 1)
    if betas.shape[1] > _MOST_BETAS or not np.allclose(betas, betas[0], atol=_SAME):
        raise UserError(f"shape file {path}: betas has shape {list(betas.shape)} and changes from row to row, wanted one shape")
    return _gender(arrays, path), betas[0].copy()


def _gender(arrays: dict[str, NDArray], path: Path) -> str:
    if "gender" not in arrays:
        log.info("%s: no gender given, neutral assumed", path.name)
        return "neutral"
    value = arrays["gender"].ravel()[0] if arrays["gender"].size else ""
    word = value.decode("latin1") if isinstance(value, bytes) else str(value)
    if len(word) > 3 and word[:2] in ("b'", 'b"'):  # bytes that Python turned into text
        word = word[2:-1]
    word = word.strip().lower()
    if word not in _GENDERS:
        raise UserError(f"shape file {path}: gender is {word[:40]!r}, wanted male, female or neutral")
    return _GENDERS[word]
