"""The descriptions of a dataclass's fields, which stand below them: for help() and for the commands' help."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import textwrap
from typing import Any, TypeVar

__all__ = ["documented", "field_texts", "texts_of_class"]

_WIDTH = 100  # of the lines that help() shows

Kind = TypeVar("Kind", bound=type)


def documented(kind: Kind) -> Kind:
    """Let help() show the descriptions of a dataclass's fields, as a section of its docstring; to stand above `dataclass`.

    The source is read when the docstring is, so that an import takes no longer. Without source the docstring stays as it is.
    """
    kind.__doc__ = _Docstring(kind, kind.__doc__)  # pyright: ignore[reportAttributeAccessIssue]  # type accepts descriptors
    return kind


def field_texts(kind: type) -> dict[str, str]:
    """Return the descriptions of a dataclass's fields by name, each in one line; base classes first, none without source."""
    texts: dict[str, str] = {}
    for owner in reversed([one for one in kind.__mro__ if dataclasses.is_dataclass(one)]):
        texts |= _own_texts(owner)
    return texts


def _own_texts(owner: type) -> dict[str, str]:
    """Return the string literals that stand below the fields of a class, which Python itself does not keep."""
    try:
        found = ast.parse(textwrap.dedent(inspect.getsource(owner))).body
    except (OSError, TypeError, SyntaxError):  # a class without a file, or with one that has changed since
        return {}
    texts: dict[str, str] = {}
    for one in found:
        if isinstance(one, ast.ClassDef) and one.name == owner.__name__:
            texts |= texts_of_class(one)
    return texts


def texts_of_class(definition: ast.ClassDef) -> dict[str, str]:
    """Return the string literals that stand below the fields of a class in parsed source, by field, each in one line."""
    texts: dict[str, str] = {}
    for field, below in itertools.pairwise(definition.body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(below, ast.Expr):
            literal = below.value
            if isinstance(literal, ast.Constant) and isinstance(literal.value, str):
                texts[field.target.id] = " ".join(literal.value.split())
    return texts


class _Docstring:
    """The docstring of a class with the descriptions of its fields, put together when it is first read."""

    def __init__(self, owner: type, text: str | None) -> None:
        self._owner, self._text, self._is_whole = owner, text, False

    def __get__(self, instance: Any, kind: type | None = None) -> str | None:
        if self._text is not None and not self._is_whole:  # None with python -OO
            texts = field_texts(self._owner)
            if texts:
                shown = [_paragraph(f"{name}: {text}") for name, text in texts.items()]
                self._text = "\n".join([inspect.cleandoc(self._text), "", "Attributes:", *shown])
            self._is_whole = True
        return self._text


def _paragraph(text: str) -> str:
    return textwrap.fill(text, _WIDTH, initial_indent=" " * 4, subsequent_indent=" " * 8, break_on_hyphens=False)
