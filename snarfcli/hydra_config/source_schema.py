"""The dataclass of a command as its source describes it: for --help, without importing PyTorch and all that the command needs.

DESIGN. The help shows names and descriptions of fields, which stand in the source. Reading a class takes milliseconds,
importing its module a second or more. Only what the settings use is understood: annotated fields, base classes, and names that
are defined in the module or imported from another one of the package. `describe` and `group_schemas` give the same for an
imported class.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from snarfcli.field_docs import texts_of_class

__all__ = ["SourceSchema", "read_schema"]

_PACKAGE = Path(__file__).parents[1]


@dataclass
class SourceSchema:
    """A dataclass in the source."""

    texts: dict[str, str] = field(default_factory=dict)
    """Description of each field, by name; empty for none."""
    groups: dict[str, SourceSchema] = field(default_factory=dict)
    """The fields whose type is a dataclass, or a dataclass or None."""

    def settings(self) -> dict[str, str]:
        """Return the descriptions of the fields that are no groups."""
        return {name: text for name, text in self.texts.items() if name not in self.groups}


def read_schema(module: str, name: str) -> SourceSchema:
    """Return a dataclass of the package; base classes first, as in the class itself.

    Args:
        module: full name of the module that defines or imports it.
        name: of the class.

    Raises:
        LookupError: there is no such class.
    """
    found = _find_class(module, name)
    if found is None:
        raise LookupError(f"{module} has no class {name}")
    home, definition = found
    schema = SourceSchema()
    for base in reversed(definition.bases):
        if isinstance(base, ast.Name) and _find_class(home, base.id):
            inherited = read_schema(home, base.id)
            schema.texts |= inherited.texts
            schema.groups |= inherited.groups
    texts = texts_of_class(definition)
    for part in definition.body:
        if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
            own = part.target.id
            schema.texts[own] = texts.get(own) or schema.texts.get(own, "")
            for kind in _alternatives(part.annotation):
                if _find_class(home, kind):
                    schema.groups[own] = read_schema(home, kind)
    return schema


def _alternatives(annotation: ast.expr) -> Iterator[str]:
    """Yield the names in an annotation such as `A` or `A | None`."""
    if isinstance(annotation, ast.Name):
        yield annotation.id
    elif isinstance(annotation, ast.BinOp):
        yield from _alternatives(annotation.left)
        yield from _alternatives(annotation.right)


def _find_class(module: str, name: str) -> tuple[str, ast.ClassDef] | None:
    """Return a class that a module of the package defines or imports, with the module that defines it."""
    for statement in _parse(module):
        if isinstance(statement, ast.ClassDef) and statement.name == name:
            return module, statement
        if isinstance(statement, ast.ImportFrom) and (statement.module or "").partition(".")[0] == _PACKAGE.name:
            for one in statement.names:
                if (one.asname or one.name) == name:
                    return _find_class(statement.module or "", one.name)
    return None


@cache
def _parse(module: str) -> list[ast.stmt]:
    """Return the statements of a module of the package."""
    path = _PACKAGE.joinpath(*module.split(".")[1:])
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return ast.parse(path.read_text(encoding="utf-8")).body
