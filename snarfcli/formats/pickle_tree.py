"""Nodes of the tree that `read_tree` makes of a pickle, besides plain values."""

from __future__ import annotations

from typing import Any

__all__ = ["Call", "Name", "PickleError", "Raw", "Unknown", "shown", "text_of"]


class PickleError(ValueError):
    """A pickle that cannot be read; the message is the end of a sentence that begins with the name of the file."""


def shown(text: object) -> str:
    """Return text from a file in a form for messages: ASCII, one line, at most 60 characters."""
    line = ascii(str(text)[:200])[1:-1]
    return line if len(line) <= 60 else line[:57] + "..."


class Name:
    """A class or function that the pickle names: its path, and its kind in `KNOWN_NAMES`."""

    __slots__ = ("kind", "path")

    def __init__(self, path: str, kind: str) -> None:
        self.path, self.kind = path, kind


class Raw:
    """Bytes or text inside the file; copied once, when the value is first read."""

    __slots__ = ("_value", "encoding", "view")

    def __init__(self, view: memoryview, encoding: str | None) -> None:
        self.view = view
        self.encoding = encoding
        """None for bytes; latin1 for strings of Python 2, which may contain bytes."""
        self._value: str | bytes | None = None

    @property
    def value(self) -> str | bytes:
        """The decoded text, or the bytes; kept, since the file may refer to it many times."""
        if self._value is None:
            self._value = self.decoded()
        return self._value

    def decoded(self) -> str | bytes:
        """Return the decoded text, or the bytes if there is no encoding."""
        if self.encoding is None:
            return bytes(self.view)
        try:
            return str(self.view, self.encoding, "surrogatepass" if self.encoding == "utf-8" else "strict")
        except UnicodeDecodeError:
            raise PickleError("has text that cannot be decoded") from None


class Call:
    """An object that the pickle asks for: its name, arguments, and the state and items that are set afterwards."""

    __slots__ = ("args", "items", "name", "state")

    def __init__(self, name: Name, args: tuple) -> None:
        self.name, self.args = name, args
        self.state: Any = None
        self.items: dict = {}


class Unknown:
    """The place of an object of an unknown class, which was not created."""

    __slots__ = ("path",)

    def __init__(self, path: str) -> None:
        self.path = path


def text_of(node: Any) -> Any:
    """Return the text or bytes of a node inside the file; any other node unchanged."""
    return node.value if isinstance(node, Raw) else node
