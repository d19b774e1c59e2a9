"""Read the gender and shape parameters of a subject from an AMASS file."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snarfcli.array_files import read_npz
from snarfcli.errors import UserError

__all__ = ["read_shape"]

log = logging.getLogger(__name__)

_GENDERS = {"male": "male", "m": "male", "female": "female", "f": "female", "neutral": "neutral", "n": "neutral", "": "neutral"}
_MAX_BETAS = 1000
_TOLERANCE = 1e-4


def read_shape(path: str | Path, *, needs_betas: bool = True) -> tuple[str, NDArray[np.float64]]:
    """Read the gender and shape parameters from `shape.npz`, a `stagei.npz`, or any sequence of AMASS.

    Args:
        path: `.npz` file with `betas`, [S], or [T, S] with equal rows, and `gender` in any spelling, as text or bytes.
        needs_betas: whether a file without `betas` is an error.

    Returns:
        gender: `male`, `female` or `neutral`; `neutral` if the file has none.
        betas: [S], shape parameters; 10 or 16 in most files, of which SMPL uses the first 10. Empty if the file has none.

    Raises:
        UserError: the file is missing or damaged; it has no shape, one that varies or is not finite, or an unknown gender.
    """
    path = Path(path)
    arrays = read_npz(path, "shape file", only=("betas", "gender"), max_bytes=2**24)
    if "betas" not in arrays and not needs_betas:
        return _gender(arrays, path), np.zeros(0)
    if "betas" not in arrays:
        raise UserError(f"shape file {path}: wanted 'betas', got none; give shape.npz or a sequence of the subject")
    betas = arrays["betas"]
    if betas.dtype.kind not in "fiu" or not betas.size or not np.isfinite(betas).all():
        raise UserError(f"shape file {path}: betas: wanted at least 1 finite number, got other values; repair the file")
    betas = betas.astype(np.float64).reshape(-1, betas.shape[-1] if betas.ndim else 1)
    if betas.shape[1] > _MAX_BETAS or not np.allclose(betas, betas[0], atol=_TOLERANCE):
        wanted = f"at most {_MAX_BETAS} values, equal in all rows"
        raise UserError(
            f"shape file {path}: betas: wanted {wanted}, got others of shape {list(betas.shape)}; give another file"
        )
    return _gender(arrays, path), betas[0].copy()


def _gender(arrays: dict[str, NDArray], path: Path) -> str:
    if "gender" not in arrays:
        log.info("%s: no gender given, neutral assumed", path.name)
        return "neutral"
    value = arrays["gender"].ravel()[0] if arrays["gender"].size else ""
    word = value.decode("latin1") if isinstance(value, bytes) else str(value)
    if len(word) > 3 and word[:2] in ("b'", 'b"'):  # bytes that were converted to text by str()
        word = word[2:-1]
    word = word.strip().lower()
    if word not in _GENDERS:
        raise UserError(f"shape file {path}: gender: wanted male, female or neutral, got {word[:40]!r}; repair the file")
    return _GENDERS[word]
