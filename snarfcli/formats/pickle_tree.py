"""What the tree of a pickle is made of, besides plain values."""

from __future__ import annotations

from typing import Any

__all__ = ["Call", "Name", "PickleError", "Raw", "shown"]


class PickleError(ValueError):
    """Why a pickle is not read, as the end of a sentence that begins with the file's name."""


def shown(text: object) -> str:
    """Make text from a file fit for a message: ASCII, one line, at most 60 characters."""
    line = ascii(str(text)[:200])[1:-1]
    return line if len(line) <= 60 else line[:57] + "..."


class Name:
    """A class or function that the pickle names, and what we take it for."""

    __slots__ = ("kind", "path")

    def __init__(self, path: str, kind: str) -> None:
        self.path, self.kind = path, kind


class Raw:
    """Bytes or text as it lies in the file, not copied before it is asked for, and then once."""

    __slots__ = ("_value", "encoding", "view")

    def __init__(self, view: memoryview, encoding: str | None) -> None:
        self.view = view
        self.encoding = encoding
        """None for bytes; latin1 for the strings of Python 2, which may also be bytes."""
        self._value: str | bytes | None = None

    @property
    def value(self) -> str | bytes:
        """The text, or the bytes if it is none; kept, so that it costs once, wherever the file refers to it."""
        if self._value is None:
            self._value = self.decoded()
        return self._value

    def decoded(self) -> str | bytes:
        """Return the text, or the bytes if it is none."""
        if self.encoding is None:
            return bytes(self.view)
        try:
            return str(self.view, self.encoding, "surrogatepass" if self.encoding == "utf-8" else "strict")
        except UnicodeDecodeError:
            raise PickleError("holds text that cannot be decoded") from None


class Call:
    """An object that the pickle wants made: by which name, of what, and the state and the items set afterwards."""

    __slots__ = ("args", "items", "name", "state")

    def __init__(self, name: Name, args: tuple) -> None:
        self.name, self.args = name, args
        self.state: Any = None
        self.items: dict = {}
