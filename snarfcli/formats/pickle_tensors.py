"""Read the pickles of video estimators as plain data: PyTorch's tensors, and arrays and dictionaries as joblib writes them."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.formats.pickle_tree import Call, Name, PickleError, Unknown, shown
from snarfcli.formats.pickle_values import KNOWN_NAMES, Reading, odd

__all__ = ["ESTIMATE_NAMES", "PLAIN_NAMES", "EstimateReading", "PlainReading", "value_size"]

log = logging.getLogger(__name__)

# Number types of PyTorch's storages. bfloat16, the upper half of a float32, is not a type of NumPy.
_STORAGES = {
    "DoubleStorage": "f8", "FloatStorage": "f4", "HalfStorage": "f2", "BFloat16Storage": "bfloat16",
    "LongStorage": "i8", "IntStorage": "i4", "ShortStorage": "i2", "CharStorage": "i1", "ByteStorage": "u1",
    "BoolStorage": "u1",
}  # fmt: skip

ESTIMATE_NAMES = {
    **KNOWN_NAMES,
    ("", "stored"): "stored",
    ("", "unknown"): "unknown",
    ("torch._utils", "_rebuild_tensor"): "tensor",
    ("torch._utils", "_rebuild_tensor_v2"): "tensor",
    ("torch._utils", "_rebuild_parameter"): "parameter",
    **{(module, name): "storage type" for module in ("torch", "torch.cuda") for name in _STORAGES},
    ("torch.storage", "_load_from_bytes"): "storage in bytes",
    ("torch", "Size"): "size",
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): "array in file",
    ("collections", "defaultdict"): "default dict",
    **{("builtins", name): "plain type" for name in ("dict", "list", "int", "float", "str", "tuple")},
    **{("__builtin__", name): "plain type" for name in ("dict", "list", "int", "float", "str", "tuple")},
}
"""Kind of each (module, name) that the results of a video estimator may contain, for `read_tree`."""

PLAIN_NAMES = {
    ("", "stored"): "stored",
    ("torch._utils", "_rebuild_tensor_v2"): "tensor",
    **{("torch", name): "storage type" for name in _STORAGES if name != "BFloat16Storage"},
    ("collections", "OrderedDict"): "dict",
}
"""Kind of each (module, name) that a file of plain data and tensors may contain, for `read_tree`."""


def value_size(kind: Any) -> int:
    """Return the bytes per value of a storage of a type.

    Args:
        kind: node of the type in the tree.

    Raises:
        PickleError: the type is unknown.
    """
    return 2 if _code(kind) == "bfloat16" else np.dtype(_code(kind)).itemsize


def _code(kind: Any) -> str:
    code = _STORAGES.get(kind.path.rsplit(".", 1)[-1]) if isinstance(kind, Name) else None
    if code is None:
        raise PickleError(f"has tensors of the type {shown(getattr(kind, 'path', kind))}, which motions do not need")
    return code


class EstimateReading(Reading):
    """Conversion of the tree of an estimator's pickle to plain data; tensors become arrays that own their memory.

    Objects of unknown classes, such as settings beside the poses, become `Unknown`; `unknown` has the names of the classes.
    """

    def __init__(
        self,
        budget: int,
        stored: Callable[[str], memoryview] | None = None,
        from_bytes: Callable[[bytes, int], Any] | None = None,
        order: str = "<",
    ) -> None:
        """Prepare the conversion.

        Args:
            budget: maximum number of bytes to create beyond those of the file.
            stored: returns the bytes of the storage of a key; None if the pickle is alone.
            from_bytes: returns the storage that is a file of `torch.save` itself, from its bytes and the budget.
            order: byte order of the storages, `<` or `>`.
        """
        super().__init__(budget)
        self.unknown: dict[str, None] = {}
        self._converted: dict[str, NDArray] = {}  # storages of bfloat16 as float32, by key
        self._in_bytes: dict[int, tuple[Any, NDArray]] = {}  # storages in bytes, by identity of the node, which is kept alive
        self.stored, self.from_bytes, self.order = stored, from_bytes, order

    def value(self, node: Any, depth: int) -> Any:
        if isinstance(node, Name) and node.kind == "unknown":
            return self.make_unknown(node)
        return super().value(node, depth)

    def report(self, path: Path) -> None:
        """Log the names of the classes whose objects were left out."""
        if self.unknown:
            names = ", ".join([*self.unknown][:5])
            log.info("%s: objects of unknown classes were left out, nothing was executed: %s", path.name, names)

    def make_unknown(self, name: Name, *_: Any) -> Unknown:
        """Return the place of an object that is not created, so that the arrays beside it can be read."""
        self.unknown[shown(name.path)] = None
        return Unknown(shown(name.path))

    def make_stored(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> NDArray:
        """Return a storage, a flat array, from ('storage', type, key, device, number of values, ...)."""
        parts = args[0] if len(args) == 1 else None
        if self.stored is None or not isinstance(parts, (tuple, list)) or len(parts) < 3:
            raise PickleError("refers to an object outside the file, which plain data does not need")
        code, key = _code(parts[1]), self.value(parts[2], depth)
        if not isinstance(key, str):
            raise odd(name)
        if code == "bfloat16" and key in self._converted:
            return self._converted[key]
        view = self.stored(key)
        dtype = np.dtype(self.order + ("u2" if code == "bfloat16" else code))
        values = np.frombuffer(view[: len(view) // dtype.itemsize * dtype.itemsize], dtype)
        if code != "bfloat16":
            return values
        self.spend(2 * len(view))
        self._converted[key] = (values.astype(np.uint32) << 16).view(np.float32)
        return self._converted[key]

    def make_storage_in_bytes(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> NDArray:
        if len(args) == 1 and id(args[0]) in self._in_bytes:
            return self._in_bytes[id(args[0])][1]
        content = self.value(args[0], depth) if len(args) == 1 else None
        if self.from_bytes is None or not isinstance(content, bytes):
            raise odd(name)
        storage = self.from_bytes(content, self.budget)
        if not isinstance(storage, np.ndarray) or storage.ndim != 1:
            raise odd(name)
        self.spend(storage.nbytes)
        self._in_bytes[id(args[0])] = args[0], storage
        return storage

    def make_tensor(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> NDArray:
        if len(args) < 4:
            raise odd(name)
        storage, first, size, strides = (self.value(part, depth) for part in args[:4])
        if not isinstance(storage, np.ndarray) or storage.ndim != 1 or type(first) is not int or not 0 <= first < 2**40:
            raise odd(name)
        if not isinstance(size, tuple) or not isinstance(strides, tuple) or len(size) != len(strides) or len(size) > 32:
            raise odd(name)
        if any(type(n) is not int or not 0 <= n < 2**40 for n in (*size, *strides)):
            raise odd(name)
        count = math.prod(size)
        rows = tuple(math.prod(size[axis + 1 :]) for axis in range(len(size)))
        is_own = strides == rows and any(storage is converted for converted in self._converted.values())
        self.spend(0 if is_own else count * storage.itemsize)
        if count and first + sum((n - 1) * stride for n, stride in zip(size, strides, strict=True)) >= len(storage):
            raise PickleError("has a tensor that is larger than its storage; it is damaged or cut off")
        if not count:
            return self.empty(name, size, storage.dtype)
        if is_own:
            return storage[first : first + count].reshape(size)
        steps = [stride * storage.itemsize for stride in strides]
        return np.lib.stride_tricks.as_strided(storage[first:], size, steps).astype(storage.dtype.newbyteorder("="))

    def empty(self, name: Name, size: tuple[int, ...], dtype: np.dtype) -> NDArray:
        try:
            return np.zeros(size, dtype.newbyteorder("="))
        except ValueError:  # no values, but too many rows
            raise odd(name) from None

    def make_parameter(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> Any:
        if not args:
            raise odd(name)
        return self.value(args[0], depth)

    def make_size(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> tuple:
        values = self.value(args[0], depth) if len(args) == 1 else None
        if not isinstance(values, (tuple, list)):
            raise odd(name)
        return tuple(values)

    def make_array_in_file(self, name: Name, args: tuple, state: Any, _: Call, depth: int) -> NDArray | list:
        if len(args) != 1 or not isinstance(state, dict):
            raise odd(name)
        order = "F" if self.value(state.get("order"), depth) == "F" else "C"
        return self.array(name, state.get("shape"), state.get("dtype"), order, args[0], depth)

    def make_default_dict(self, name: Name, args: tuple, state: Any, call: Call, depth: int) -> dict:
        if len(args) > 1 or any(not isinstance(arg, Name) or arg.kind != "plain type" for arg in args):
            raise odd(name)
        return {key: self.value(item, depth) for key, item in call.items.items()}


EstimateReading.makers = {
    **Reading.makers,
    "stored": EstimateReading.make_stored,
    "unknown": EstimateReading.make_unknown,
    "tensor": EstimateReading.make_tensor,
    "parameter": EstimateReading.make_parameter,
    "storage in bytes": EstimateReading.make_storage_in_bytes,
    "size": EstimateReading.make_size,
    "array in file": EstimateReading.make_array_in_file,
    "default dict": EstimateReading.make_default_dict,
}


class PlainReading(EstimateReading):
    """Conversion of the tree of a file that holds plain data and tensors only; tensors of bool become arrays of bool."""

    def make_stored(self, name: Name, args: tuple, state: Any, call: Call, depth: int) -> NDArray:
        values = super().make_stored(name, args, state, call, depth)
        kind = args[0][1]
        if not isinstance(kind, Name) or not kind.path.endswith(".BoolStorage"):
            return values
        self.spend(values.nbytes)
        return values != 0  # not a view: PyTorch's kernels assume that the bytes of bool are 0 and 1


PlainReading.makers = {kind: EstimateReading.makers[kind] for kind in ("dict", "tensor")} | {"stored": PlainReading.make_stored}
