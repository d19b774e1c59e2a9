"""Plain data from files, checked and turned into dataclasses: configurations, manifests, records.

Nothing in such data is resolved or executed: `${...}` is text. Every value has the type that the dataclass names; numbers are
finite, and texts, lists and nesting are bounded. Names that the dataclass lacks are errors.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from functools import cache
from typing import Any, TypeVar

from snarfcli.errors import nearest
from snarfcli.texts import one_line

__all__ = ["DescriptionError", "check_plain", "read_described"]

_MOST_DEPTH = 20
_MOST_ENTRIES = 1_000_000
_LONGEST_TEXT = 100_000
_MOST_NUMBER = 2**63
_MISSING = "???"  # OmegaConf's mark of a value that must be given
_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", type(None): "nothing"}

T = TypeVar("T")


class DescriptionError(ValueError):
    """Data that is not what was wanted; the message is one line `name: wanted X, got Y`, without the name of the file."""


def read_described(kind: type[T], content: Any, name: str, *, ignore_unknown: bool = False) -> T:
    """Return an object of a dataclass from the plain data that describes it.

    Values that are left out get their defaults. A whole number is accepted where a number is wanted, a list where a tuple is.

    Args:
        kind: dataclass whose fields are bool, int, float, str, Any, other such dataclasses, `X | None`, `list[X]`,
            `tuple[X, ...]` and `dict[str, X]` of these.
        content: nested dicts and lists.
        name: of the content, for messages.
        ignore_unknown: whether names without a field are left out instead of being errors.

    Raises:
        DescriptionError: the content does not describe such an object.
    """
    check_plain(content, name)
    return _read(kind, content, name, ignore_unknown)


def check_plain(content: Any, name: str, *, finite: bool = True) -> None:
    """Check that content consists of dicts with texts as keys, lists, tuples, texts, finite numbers, bool and None only.

    Args:
        content: the content.
        name: of the content, for messages.
        finite: whether NaN and infinity are errors.

    Raises:
        DescriptionError: it does not, is nested too deeply (as content that contains itself is), or is too large.
    """
    seen = 0
    parts: list[tuple[Any, str, int]] = [(content, name, 0)]
    while parts:
        part, where, depth = parts.pop()
        seen += 1
        if depth > _MOST_DEPTH or seen > _MOST_ENTRIES:
            limit = f"{_MOST_DEPTH} levels" if depth > _MOST_DEPTH else f"{_MOST_ENTRIES} values"
            raise DescriptionError(f"{name}: wanted at most {limit}, got more")
        if isinstance(part, dict):
            unnamed = [key for key in part if type(key) is not str or len(key) > _LONGEST_TEXT or not _is_writable(key)]
            if unnamed:
                raise _wrong(where, "texts as names", unnamed[0])
            parts += [(value, _below(where, key), depth + 1) for key, value in part.items()]
        elif type(part) in (list, tuple):
            parts += [(value, where, depth + 1) for value in part]
        else:
            _check_value(part, where, finite)


def _check_value(value: Any, where: str, finite: bool) -> None:
    """Check one value that is no container."""
    if type(value) not in _WORDS:
        raise _wrong(where, "plain data", value)
    if isinstance(value, str) and len(value) > _LONGEST_TEXT:
        raise DescriptionError(f"{where}: wanted a text of at most {_LONGEST_TEXT} characters, got {len(value)}")
    if isinstance(value, str) and not _is_writable(value):
        raise _wrong(where, "a text that can be written", value)
    if type(value) is int and abs(value) > _MOST_NUMBER:
        raise DescriptionError(f"{where}: wanted a number of at most 19 digits, got a longer one")
    if finite and type(value) is float and not math.isfinite(value):
        raise _wrong(where, "a finite number", value)


def _is_writable(text: str) -> bool:
    """Return whether a text has no halves of surrogate pairs, which no file or terminal takes."""
    return text.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in text)


def _read(kind: Any, value: Any, where: str, ignore_unknown: bool) -> Any:
    """Return the object of one type for a value."""
    if kind is Any:
        return value
    if dataclasses.is_dataclass(kind):
        return _read_dataclass(kind, value, where, ignore_unknown)
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        if value is None and type(None) in inner:
            return None
        (some,) = [one for one in inner if one is not type(None)]
        return _read(some, value, where, ignore_unknown)
    if origin in (list, tuple):
        if type(value) not in (list, tuple):
            raise _wrong(where, "a list", value)
        return origin(_read(inner[0], one, f"{where}[{index}]", ignore_unknown) for index, one in enumerate(value))
    if origin is dict:
        if not isinstance(value, dict):
            raise _wrong(where, "names with values", value)
        return {key: _read(inner[1], one, _below(where, key), ignore_unknown) for key, one in value.items()}
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise _wrong(where, _WORDS[kind], value)
    return value


def _read_dataclass(kind: Any, value: Any, where: str, ignore_unknown: bool) -> Any:
    """Return an object of a dataclass."""
    if not isinstance(value, dict):
        raise _wrong(where, "names with values", value)
    fields = _fields(kind)
    unknown = next((key for key in value if key not in fields), None)
    if unknown is not None and not ignore_unknown:
        raise DescriptionError(f"{where}: {one_line(unknown, 60)} is no setting of this version{nearest(unknown, fields)}")
    given = {key: _read(fields[key], value[key], _below(where, key), ignore_unknown) for key in fields if key in value}
    for field in dataclasses.fields(kind):
        has_default = field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
        if field.name not in given and (not has_default or field.default == _MISSING):
            raise DescriptionError(f"{_below(where, field.name)}: wanted a value, got none")
    return kind(**given)


@cache
def _fields(kind: type) -> dict[str, Any]:
    """Return the types of the fields of a dataclass by name."""
    hints = typing.get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def _below(where: str, key: str) -> str:
    return f"{where}.{one_line(key, 60)}" if where else one_line(key, 60)


def _wrong(where: str, wanted: str, value: Any) -> DescriptionError:
    is_short = type(value) in (bool, float, type(None)) or (type(value) is int and abs(value) <= _MOST_NUMBER)
    is_short |= type(value) is str and len(value) <= 60
    came = repr(value) if is_short else f"a {type(value).__name__}"
    return DescriptionError(f"{where}: wanted {wanted}, got {one_line(came, 80)}")
