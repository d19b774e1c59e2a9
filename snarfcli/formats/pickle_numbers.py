"""Create the arrays of a pickle from their parts, after checking that these fit together."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from snarfcli.formats.pickle_tree import Call, PickleError, shown, text_of

__all__ = ["SPARSE_FORMS", "SparseMatrix", "checked_shape", "dtype_of", "make_array", "make_sparse", "select"]

SPARSE_FORMS = ("csc", "csr", "coo")
"""Formats of SciPy's sparse matrices that are read."""
# Numbers and text. `O8` is the type of objects in Python 2.
_DTYPE = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248]|c8|c16|[SU][1-9]\d{0,6}|O[48]?)")


@dataclass(frozen=True, eq=False)
class SparseMatrix:
    """The entries of a sparse matrix that SciPy wrote; they are read without SciPy."""

    shape: tuple[int, int]
    """Rows and columns."""
    values: NDArray
    """[K], numbers; those at one place are added."""
    rows: NDArray
    """[K], whole numbers."""
    columns: NDArray
    """[K], whole numbers."""

    def toarray(self) -> NDArray:
        """Return the matrix with its zeros. Look at `shape` first: a small file can state a huge one."""
        array = np.zeros(self.shape, self.values.dtype)
        np.add.at(array, (self.rows, self.columns), self.values)
        return array


def _make_dtype(code: Any, order: Any) -> np.dtype:
    """Return the type of an array from its code, for example `f8`, and its byte order."""
    match = _DTYPE.fullmatch(code) if isinstance(code, str) else None
    if match is None:
        raise PickleError(f"array type: wanted numbers or text, got {shown(code)}")
    if order is None:
        order = code[0] if code[0] in "<>|=" else "="
    if order not in ("<", ">", "|", "="):
        raise PickleError("has an array without a byte order; it is damaged")
    return np.dtype(object if match[1][0] == "O" else order + match[1])


def dtype_of(node: Any) -> np.dtype:
    """Return the type of an array from the node of NumPy's type object.

    Raises:
        PickleError: it is no type of numbers or text.
    """
    if not isinstance(node, Call) or node.name.kind != "dtype" or not node.args:
        raise PickleError("has an array without a type; it is damaged")
    order = None
    if node.state is not None:  # (version, byte order, base of a subarray, names, fields, ...)
        if not isinstance(node.state, tuple) or len(node.state) < 5 or any(part is not None for part in node.state[2:5]):
            raise PickleError("array type: wanted numbers or text, got records")
        order = text_of(node.state[1])
    return _make_dtype(text_of(node.args[0]), order)


def checked_shape(shape: Any) -> tuple[int, ...]:
    """Return the shape of an array as a tuple.

    Raises:
        PickleError: it is not a valid shape.
    """
    sizes = (shape,) if type(shape) is int else shape
    if not isinstance(sizes, tuple) or len(sizes) > 32 or any(type(n) is not int or not 0 <= n < 2**40 for n in sizes):
        raise PickleError("has an array without a valid shape; it is damaged")
    return sizes


def make_array(shape: tuple[int, ...], dtype: np.dtype, order: Literal["C", "F"], view: memoryview) -> NDArray:
    """Return an array of numbers or text that owns its memory, aligned and in native byte order.

    Args:
        shape: of the array.
        dtype: of the values in `view`.
        order: C for rows first, F for columns first.
        view: bytes of the values.

    Raises:
        PickleError: the parts do not fit together, or text cannot be decoded.
    """
    if math.prod(shape) * dtype.itemsize != len(view):
        raise PickleError(
            f"has {len(view)} bytes for an array of shape {shown(list(shape))} and type {dtype}; it is damaged or cut off"
        )
    native = dtype.newbyteorder("=")
    if not len(view):
        try:
            return np.zeros(shape, native)
        except ValueError:  # no values, but too many rows
            raise PickleError("has an array without a valid shape; it is damaged") from None
    if dtype.kind == "b":  # the file may have any byte, and NumPy requires 0 or 1
        return (np.frombuffer(view, np.uint8) != 0).reshape(shape, order=order)
    array = np.frombuffer(view, dtype).astype(native)
    if dtype.kind == "U" and array.view(np.uint32).max() > 0x10FFFF:
        raise PickleError("has text that cannot be decoded; it is damaged")
    return array.reshape(shape, order=order)


def select(source: Any, chosen: Any, shape: Any) -> NDArray:
    """Return chumpy's selection `source.ravel()[chosen].reshape(shape)`.

    Raises:
        PickleError: the parts do not fit together.
    """
    if not isinstance(source, np.ndarray) or not isinstance(chosen, np.ndarray) or chosen.dtype.kind not in "iu":
        raise PickleError("has a chumpy selection without an array or without indices; it is damaged")
    shape = chosen.shape if shape is None else checked_shape(shape)
    if math.prod(shape) != chosen.size:
        raise PickleError("has a chumpy selection whose shape does not fit its indices; it is damaged")
    if not _are_within(chosen, source.size):
        raise PickleError("has a chumpy selection with indices out of range; it is damaged")
    return source.ravel()[chosen.astype(np.int64)].reshape(shape)


def make_sparse(form: str, shape: Any, data: Any, index: Sequence[Any]) -> SparseMatrix:
    """Return a sparse matrix.

    Args:
        form: csc, csr or coo.
        shape: of the matrix.
        data: [K], its values.
        index: for coo the rows [K] and the columns [K]; else the indices [K] and the start of each column or row among them.

    Raises:
        PickleError: the parts do not fit together.
    """
    damaged = PickleError(f"has a sparse matrix ({form}) whose parts do not fit together; it is damaged")
    arrays = (data, *index)
    if not all(isinstance(array, np.ndarray) and array.ndim == 1 for array in arrays) or data.dtype.kind not in "fiub":
        raise damaged
    if len(index) != 2 or any(part.dtype.kind not in "iu" for part in index):
        raise damaged
    if not isinstance(shape, tuple) or len(shape) != 2 or any(type(n) is not int or not 0 <= n < 2**31 for n in shape):
        raise damaged
    if form == "coo":
        if any(len(part) != len(data) or not _are_within(part, size) for part, size in zip(index, shape, strict=True)):
            raise damaged
        return SparseMatrix(shape, data, *index)
    entries, starts = index[0], index[1].astype(np.int64)
    major, minor = shape if form == "csr" else shape[::-1]
    if len(starts) != major + 1 or starts[0] != 0 or (np.diff(starts) < 0).any():
        raise damaged
    if not starts[-1] == len(entries) == len(data) or not _are_within(entries, minor):
        raise damaged
    counted = np.repeat(np.arange(major), np.diff(starts))
    rows, columns = (counted, entries) if form == "csr" else (entries, counted)
    return SparseMatrix(shape, data, rows, columns)


def _are_within(array: NDArray, size: int) -> bool:
    return not array.size or (int(array.min()) >= 0 and int(array.max()) < size)
