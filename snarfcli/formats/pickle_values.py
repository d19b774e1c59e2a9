"""Turn the tree of a pickle into plain data: numbers, text, containers and NumPy arrays."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from snarfcli.formats.pickle_numbers import (
    SPARSE_FORMS,
    SparseMatrix,
    checked_shape,
    dtype_of,
    make_array,
    make_sparse,
    select,
)
from snarfcli.formats.pickle_tree import Call, Name, PickleError, Raw, shown, text_of

__all__ = ["KNOWN_NAMES", "Reading", "odd", "plain_data"]

_MAX_DEPTH = 64
_MAX_VALUES = 10_000_000

KNOWN_NAMES = {
    ("numpy", "ndarray"): "array type",
    ("numpy", "matrix"): "array type",
    ("numpy.matrixlib.defmatrix", "matrix"): "array type",
    ("numpy", "dtype"): "dtype",
    **{(f"numpy.{core}.multiarray", "_reconstruct"): "array" for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): "scalar" for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): "array from bytes" for core in ("core", "_core")},
    ("chumpy", "Ch"): "chumpy value",
    ("chumpy.ch", "Ch"): "chumpy value",
    ("chumpy.reordering", "Select"): "chumpy selection",
    **{
        (f"scipy.sparse{module.format(form)}", f"{form}_{suffix}"): form
        for form in SPARSE_FORMS
        for module in (".{}", "._{}", "")
        for suffix in ("matrix", "array")
    },
    ("_codecs", "encode"): "bytes from text",
    **{(module, "_reconstructor"): "object of" for module in ("copy_reg", "copyreg")},
    **{
        (module, name): kind
        for module in ("__builtin__", "builtins")
        for name, kind in {"object": "object", "set": "set", "frozenset": "set", "bytes": "bytes"}.items()
    },
    ("collections", "OrderedDict"): "dict",
}
"""Kind of each (module, name) that plain data may contain, for `read_tree`."""


def plain_data(tree: Any, budget: int) -> Any:
    """Return the plain data of a pickle's tree.

    Args:
        tree: what `read_tree` returned for `KNOWN_NAMES`.
        budget: maximum number of bytes to create beyond those of the file.

    Raises:
        PickleError: the tree is damaged, too large, or contains itself.
    """
    return Reading(budget).value(tree, 0)


class Reading:
    """Conversion of a pickle's tree to plain data, with counters that keep a small file from becoming large."""

    makers: ClassVar[dict[str, Callable[..., Any]]] = {}
    """The method per kind of object."""

    def __init__(self, budget: int) -> None:
        self.budget = budget
        self.count = 0
        self.deepest = 0
        # Per node: its result, number of values and depth; None while it is being read. The key is the identity of the node,
        # which is stable because the tree outlives this object.
        self.done: dict[int, tuple[Any, int, int] | None] = {}

    def spend(self, count: int) -> None:
        self.budget -= count
        if self.budget < 0:
            raise PickleError("becomes far larger when read than the file; no known program writes such files")

    def value(self, node: Any, depth: int) -> Any:
        self.count += 1
        self.deepest = max(self.deepest, depth)
        if node is None or isinstance(node, (bool, int, float, str, bytes)):
            return node
        if isinstance(node, Raw):
            return node.value
        if isinstance(node, Name):
            raise PickleError(f"has the class {shown(node.path)} as a value, which plain data does not need")
        result = None
        if id(node) in self.done:
            seen = self.done[id(node)]
            if seen is None:
                raise PickleError("has a list or object that contains itself, which plain data does not need")
            result, count, height = seen
            self.count += count
            self.deepest = max(self.deepest, depth + height)
        if self.count > _MAX_VALUES or self.deepest > _MAX_DEPTH:
            limit = f"{_MAX_VALUES:,} values" if self.count > _MAX_VALUES else f"{_MAX_DEPTH} levels"
            raise PickleError(f"has more than {limit}; models and motions store arrays")
        if id(node) in self.done:
            return result
        count, deepest = self.count, self.deepest
        self.done[id(node)], self.deepest = None, depth
        result = self.container(node, depth + 1)
        self.done[id(node)] = result, self.count - count, self.deepest - depth
        self.deepest = max(self.deepest, deepest)
        return result

    def container(self, node: Any, depth: int) -> Any:
        if isinstance(node, Call):
            return self.call(node, depth)
        if isinstance(node, dict):
            return {key: self.value(item, depth) for key, item in node.items()}
        if isinstance(node, (set, frozenset)):
            return set(node)
        return type(node)(self.value(item, depth) for item in node)  # list or tuple

    def call(self, call: Call, depth: int) -> Any:
        name, args, state = call.name, call.args, call.state
        if name.kind == "object of":  # protocols 0 and 1: (class, object, None) creates an empty instance
            if len(args) != 3 or not isinstance(args[0], Name) or _kind(args[1]) != "object" or args[2] is not None:
                raise odd(name)
            name, args = args[0], ()
        if call.items and name.kind not in ("dict", "default dict"):
            raise odd(name)
        make = self.makers.get(name.kind)
        if make is None:
            raise odd(name)
        return make(self, name, args, state, call, depth)

    # One method per kind of object.

    def make_array(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> Any:
        if len(args) != 3 or _kind(args[0]) != "array type" or not isinstance(state, tuple) or len(state) not in (4, 5):
            raise odd(name)
        shape, dtype, is_fortran, data = state[-4:]
        return self.array(name, shape, dtype, "F" if is_fortran is True or is_fortran == 1 else "C", data, depth)

    def make_array_from_bytes(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> Any:
        if len(args) != 4 or state is not None:
            raise odd(name)
        data, dtype, shape, order = args
        order = self.value(order, depth)
        if order not in ("C", "F", None):
            raise odd(name)
        return self.array(name, shape, dtype, order or "C", data, depth)

    def make_scalar(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> Any:
        if len(args) != 2 or state is not None:
            raise odd(name)
        value = self.array(name, (), args[0], "C", args[1], depth)
        if not isinstance(value, np.ndarray):
            raise odd(name)
        return value.item()

    def array(self, name: Name, shape: Any, dtype: Any, order: Literal["C", "F"], data: Any, depth: int) -> NDArray | list:
        shape, dtype = checked_shape(shape), dtype_of(dtype)
        if dtype.kind == "O":
            if not isinstance(data, list) or len(data) != math.prod(shape):
                raise PickleError(f"has an array of shape {shown(list(shape))} and another number of objects; it is damaged")
            return [self.value(item, depth) for item in data]
        view = self.bytes(name, data, depth)
        self.spend(len(view))
        return make_array(shape, dtype, order, view)

    def bytes(self, name: Name, node: Any, depth: int) -> memoryview:
        if isinstance(node, Raw) and node.encoding != "utf-8":
            return node.view
        value = node if isinstance(node, str) else self.value(node, depth)
        if isinstance(value, str):
            value = self.encoded(value)
        if not isinstance(value, bytes):
            raise odd(name)
        return memoryview(value)

    def encoded(self, text: str) -> bytes:
        self.spend(len(text))
        try:
            return text.encode("latin1")
        except UnicodeEncodeError:
            raise PickleError("has text in place of bytes; it is damaged") from None

    def make_bytes_from_text(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> bytes:
        if len(args) != 2 or state is not None or text_of(args[1]) not in ("latin1", "latin-1"):
            raise odd(name)
        text = args[0].decoded() if isinstance(args[0], Raw) else args[0]  # not kept, since it may be most of the file
        if not isinstance(text, str):
            raise odd(name)
        return self.encoded(text)

    def make_bytes(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> bytes:
        if args or state is not None:
            raise odd(name)
        return b""

    def make_set(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> set:
        values = self.value(args[0], depth) if len(args) == 1 else () if not args else None
        if not isinstance(values, (list, tuple)) or state is not None:
            raise odd(name)
        return self.keyed(name, [(value, None) for value in values]).keys() | set()

    def make_dict(self, name: Name, args: tuple, state: Any, call: Call, depth: int) -> dict:
        pairs = self.value(args[0], depth) if len(args) == 1 else [] if not args else None
        if not isinstance(pairs, list) or state or any(not isinstance(pair, (list, tuple)) or len(pair) != 2 for pair in pairs):
            raise odd(name)
        return {**self.keyed(name, pairs), **{key: self.value(item, depth) for key, item in call.items.items()}}

    def keyed(self, name: Name, pairs: list) -> dict:
        if any(key is not None and not isinstance(key, (str, int, float, bytes)) for key, _ in pairs):
            raise odd(name)
        return dict(pairs)

    def make_chumpy_value(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> Any:
        if not isinstance(state, dict) or "x" not in state:
            raise odd(name)
        value = self.value(state["x"], depth)
        if isinstance(value, (bool, int, float)):
            return np.array(value)
        if not isinstance(value, (np.ndarray, SparseMatrix)):
            raise odd(name)
        return value

    def make_chumpy_selection(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> NDArray:
        if not isinstance(state, dict):
            raise odd(name)
        source, chosen, shape = (self.value(state.get(key), depth) for key in ("a", "idxs", "preferred_shape"))
        if isinstance(source, np.ndarray) and isinstance(chosen, np.ndarray):
            self.spend(chosen.size * (source.itemsize + 8) + (0 if source.flags.c_contiguous else source.nbytes))
        return select(source, chosen, shape)

    def make_sparse(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> SparseMatrix:
        if not isinstance(state, dict):
            raise odd(name)
        keys = ("row", "col") if name.kind == "coo" else ("indices", "indptr")
        shape, data, coords, *index = (self.value(state.get(key), depth) for key in ("_shape", "data", "coords", *keys))
        index = coords if name.kind == "coo" and isinstance(coords, tuple) else index
        self.spend(sum(2 * part.nbytes + 8 * part.size for part in (data, *index) if isinstance(part, np.ndarray)))
        return make_sparse(name.kind, shape, data, index)


def _kind(node: Any) -> str | None:
    if isinstance(node, Call):
        node = node.name
    return node.kind if isinstance(node, Name) else None


def odd(name: Name) -> PickleError:
    """Return the error for an object whose parts are not those that its class has."""
    return PickleError(f"has a {shown(name.path)} of an unknown form; it is damaged or made by another program")


Reading.makers = {
    "array": Reading.make_array,
    "array from bytes": Reading.make_array_from_bytes,
    "scalar": Reading.make_scalar,
    "chumpy value": Reading.make_chumpy_value,
    "chumpy selection": Reading.make_chumpy_selection,
    **dict.fromkeys(SPARSE_FORMS, Reading.make_sparse),
    "bytes from text": Reading.make_bytes_from_text,
    "bytes": Reading.make_bytes,
    "set": Reading.make_set,
    "dict": Reading.make_dict,
}
