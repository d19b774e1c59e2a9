"""Named values of a JSON object or an `.npz` archive that a user wrote, checked when they are read."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from snarfcli.array_files import read_npz
from snarfcli.errors import UserError

__all__ = ["NamedValues"]

_MAX_JSON_BYTES = 2**25  # 32 MiB, about 600 MiB after parsing; an hour of poses fits into an .npz
_MAX_NPZ_BYTES = 2**28
_MAX_NUMBERS = 2**25  # 256 MiB as float64: 35,000 frames of 60 bone transforms
_MAX_VALUE = 1e9  # larger lengths and angles are invalid, and overflow when squared


class NamedValues:
    """The values of one file by name; each method checks the value that it returns and raises UserError."""

    def __init__(self, path: str | Path, what: str, aliases: Mapping[str, Sequence[str]]) -> None:
        """Read a file.

        Args:
            path: the file, `.npz` or JSON.
            what: name of the kind of file, for messages.
            aliases: per name, the accepted names in the file.

        Raises:
            UserError: it is missing, damaged or too large.
        """
        self.path, self.what, self._aliases = Path(path), what, aliases
        is_npz = self.path.suffix.lower() == ".npz"
        keys = list(chain.from_iterable(aliases.values()))
        self.values: Mapping[str, Any] = (
            read_npz(self.path, what, only=keys, max_bytes=_MAX_NPZ_BYTES) if is_npz else self._read_json()
        )

    def fail(self, message: str) -> NoReturn:
        """Raise a UserError that names the file."""
        raise UserError(f"{self.what} {self.path}: {message}")

    def _read_json(self) -> dict[str, Any]:
        if not self.path.is_file():
            raise UserError(f"no {self.what} at {self.path}")
        try:
            size = self.path.stat().st_size
            if size > _MAX_JSON_BYTES:
                limit = _MAX_JSON_BYTES / 2**20
                self.fail(f"wanted at most {limit:.0f} MiB of JSON, got {size / 2**20:.0f}; write it as .npz")
            values = json.loads(self.path.read_bytes().decode("utf-8-sig"))
        except OSError as error:
            self.fail(f"cannot be read ({error.strerror or type(error).__name__})")
        except UserError:
            raise
        except (
            ValueError,
            RecursionError,
        ):  # bad UTF-8, bad JSON, a number of over 4300 digits, or lists that are nested too deeply
            self.fail("is not valid JSON; write it again")
        return values if isinstance(values, dict) else self.fail("is not a JSON object; see data/README.md")

    def get(self, name: str) -> Any:
        """Return a value, None if there is none."""
        return next((self.values[key] for key in self._aliases[name] if self.values.get(key) is not None), None)

    def numbers(self, name: str, shape: Sequence[int | None]) -> NDArray[np.float64]:
        """Return finite numbers.

        Args:
            name: name of the value.
            shape: wanted shape; None stands for any length. [T, A, B] may also be given as [T, A * B].
        """
        value = self.get(name)
        wanted = "x".join("T" if length is None else str(length) for length in shape)
        array = _nested(value, len(shape)) if isinstance(value, list) else value
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
            self.fail(f"{name}: wanted {wanted} numbers, got other values; repair it")
        if array.size > _MAX_NUMBERS:
            self.fail(f"{name}: wanted at most {_MAX_NUMBERS} numbers, got {array.size}; cut the sequence into parts")
        lengths = [length for length in shape if length is not None]
        if array.ndim == 2 and len(shape) == 3 and array.shape[1] == math.prod(lengths) and shape[0] is None:
            array = array.reshape(len(array), *lengths)
        fits = array.ndim == len(shape) and all(b in (None, a) for a, b in zip(array.shape, shape, strict=True))
        if not fits:
            self.fail(f"{name}: wanted shape {wanted}, got {'x'.join(map(str, array.shape)) or 'one number'}; repair it")
        array = array.astype(np.float64)
        bad = ~(np.abs(array) < _MAX_VALUE)
        if bad.any():
            where = f" in frame {np.argwhere(bad)[0][0]}" if shape[0] is None else ""
            wanted = f"wanted finite numbers below {_MAX_VALUE:g}"
            self.fail(f"{name}: {wanted}, got NaN, infinity or larger ones{where}; repair them")
        return array

    def flags(self, name: str, count: int) -> NDArray[np.bool_] | None:
        """Return `count` truth values, None if there are none."""
        value = self.get(name)
        if value is None:
            return None
        array = np.array(value) if isinstance(value, list) and all(type(flag) is bool for flag in value) else value
        if not isinstance(array, np.ndarray) or array.dtype.kind != "b" or array.shape != (count,):
            self.fail(f"{name}: wanted {count} values true or false, got other values; repair it")
        return array

    def text(self, name: str) -> str | None:
        """Return a short text, None if there is none."""
        value = self.get(name)
        if isinstance(value, np.ndarray) and value.dtype.kind in "US" and value.size == 1 and value.itemsize < 4000:
            value = value.reshape(-1)[0]
        value = value.decode("latin1") if isinstance(value, bytes) else value
        if value is not None and not isinstance(value, str):
            self.fail(f"{name}: wanted a text, got another value; repair it")
        return value

    def positive(self, name: str) -> float | None:
        """Return a positive number, None if there is none."""
        value = self.get(name)
        if isinstance(value, np.ndarray) and value.size == 1 and value.dtype.kind in "fiu":
            value = value.reshape(-1)[0].item()
        if value is None:
            return None
        if type(value) not in (int, float) or not 1e-9 < value < 1e9:
            self.fail(f"{name}: wanted a positive number, got another value; repair it")
        return float(value)


def _nested(value: list[Any], depth: int) -> NDArray[np.float64] | None:
    """Return nested lists of numbers as an array; None if lengths differ or entries are not plain numbers."""
    shape = [len(value)]
    for _ in range(depth - 1):
        if not value or not all(isinstance(item, list) for item in value):
            return np.array(value, np.float64).reshape(shape) if not value else _numbers(value, shape)
        if any(len(item) != len(value[0]) for item in value):
            return None
        shape.append(len(value[0]))
        value = list(chain.from_iterable(value))
    return _numbers(value, shape)


def _numbers(flat: list[Any], shape: list[int]) -> NDArray[np.float64] | None:
    if not all(type(number) in (int, float) for number in flat):
        return None
    try:
        return np.array(flat, np.float64).reshape(shape)
    except OverflowError:  # an integer of over 300 digits
        return None
