"""The settings of a command: its dataclasses, their descriptions, and a check of overrides against them."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import re
import textwrap
import typing
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from snarfcli.errors import UserError, nearest, one_line

__all__ = [
    "check_overrides",
    "config_folder",
    "describe",
    "group_options",
    "group_schemas",
    "in_brackets",
    "list_settings",
    "preset_groups",
    "quote",
    "quote_items",
    "register_schemas",
    "setting_names",
]


def config_folder() -> Path:
    """Return the folder with the yaml files: inside the package when installed, at the top of a checkout."""
    inside = Path(__file__).parent / "conf"
    return inside if inside.is_dir() else Path(__file__).parents[1] / "conf"


def preset_groups(schema: type, command: str) -> dict[str, str]:
    """Return the plain fields of a command's dataclass that name a preset, and the group of its options: a folder by the
    command's name in one by the field's, such as experiment/train."""
    groups = {field.name: f"{field.name}/{command}" for field in dataclasses.fields(schema)}
    return {name: group for name, group in groups.items() if (config_folder() / group).is_dir()}


def group_options(group: str) -> list[str]:
    """Return the options of a configuration group, such as complete and broyden for `search`."""
    return sorted(path.stem for path in (config_folder() / group).glob("*.yaml"))


def group_schemas(schema: type) -> dict[str, type]:
    """Return the fields of a dataclass that are dataclasses themselves, or may be, by name."""
    hints = typing.get_type_hints(schema)
    kinds = {field.name: typing.get_args(hints[field.name]) or (hints[field.name],) for field in dataclasses.fields(schema)}
    return {name: kind for name, options in kinds.items() for kind in options if dataclasses.is_dataclass(kind)}


def register_schemas(name: str, schema: type) -> None:
    """Put the dataclass of a command, and those of its fields, into Hydra's store as `schema/...`."""
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance()
    store.store(group="schema", name=name, node=schema)
    for group, node in group_schemas(schema).items():
        store.store(group="schema", name=group, node=node)


def describe(schema: type) -> Iterator[tuple[str, str]]:
    """Yield the name of each plain field of a dataclass, its bases' first, and the docstring below it."""
    texts: dict[str, str] = {}
    for owner in reversed([kind for kind in schema.__mro__ if dataclasses.is_dataclass(kind)]):
        body = ast.parse(textwrap.dedent(inspect.getsource(owner))).body[0].body  # type: ignore[attr-defined]
        for field, below in itertools.pairwise(body):
            is_text = (
                isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str)
            )
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and is_text:
                texts[field.target.id] = " ".join(below.value.value.split())
    nested = group_schemas(schema)
    for field in dataclasses.fields(schema):
        if field.name not in nested:
            yield field.name, texts.get(field.name, "")


def setting_names(schema: type, prefix: str = "") -> list[str]:
    """Return the dotted names of all settings of a dataclass."""
    nested = group_schemas(schema)
    names: list[str] = []
    for field in dataclasses.fields(schema):
        name = prefix + field.name
        names += [name, *setting_names(nested[field.name], name + ".")] if field.name in nested else [name]
    return names


def list_settings(schema: type, prefix: str = "") -> set[str]:
    """Return the dotted names of all settings of a dataclass that are lists, or may be."""
    nested, hints = group_schemas(schema), typing.get_type_hints(schema)
    names: set[str] = set()
    for field in dataclasses.fields(schema):
        kinds = (hints[field.name], *typing.get_args(hints[field.name]))
        if any(typing.get_origin(kind) is list for kind in kinds):
            names.add(prefix + field.name)
        elif field.name in nested:
            names |= list_settings(nested[field.name], f"{prefix}{field.name}.")
    return names


def in_brackets(override: str, lists: Collection[str]) -> str:
    """Return an override of a setting that is a list with its brackets: views=front,left is views=[front,left]."""
    name, _, value = override.partition("=")
    is_bare = name in lists and value not in ("", "null") and not value.startswith("[") and "${" not in value
    return f"{name}=[{value}]" if is_bare else override


def check_overrides(overrides: Sequence[str], schema: type, command: str = "") -> None:
    """Refuse overrides of a command that name no setting, or no option of a choice, with the nearest valid name.

    Raises:
        UserError: for the first override that does not fit.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser = OverridesParser.create()
    names = setting_names(schema)
    groups = {name: name for name in group_schemas(schema)} | preset_groups(schema, command)
    hints = typing.get_type_hints(schema)
    for text in overrides:
        try:
            override = parser.parse_override(text)
        except HydraException as error:
            raise UserError(f"cannot read {text!r} ({one_line(error)}); quote special characters: NAME='\"VALUE\"'") from None
        key = override.key_or_group
        if key.split(".")[0] == "hydra" or key.startswith("hydra/"):
            continue
        if key not in names:
            raise UserError(f"unknown setting '{key}'{nearest(key, names)}; \"--help\" lists all settings")
        group = key.split(".")[0]
        is_chosen = any(other.startswith(f"{group}=") for other in overrides)
        if group != key and type(None) in typing.get_args(hints[group]) and not is_chosen:
            raise UserError(f"{key} needs a choice of {group} with it, such as {group}={group_options(group)[0]}")
        if key in groups:
            options = group_options(groups[key])
            left_out = ", or leave it out" if type(None) in typing.get_args(hints[key]) else ""
            for value in _values(override):
                option = "null" if value is None else str(value)
                if option not in options:
                    near = nearest(option, options)
                    raise UserError(f"there is no {key}={option}{near}; choose from {', '.join(options)}{left_out}")


def _values(override: Any) -> list[Any]:
    """Return the value of an override, or all values of a sweep."""
    if override.is_sweep_override():
        return [value.strip("'\"") for value in override.sweep_string_iterator()]
    return [override.value()]


def quote(value: str) -> str:
    """Return a value that Hydra's grammar reads back as the same text, whatever characters it has."""
    # Within quotes only a quote is special, and so are the backslashes that lead up to one.
    escaped = re.sub(r"(\\*)('|$)", lambda match: match.group(1) * 2 + ("\\'" if match.group(2) else ""), value)
    return f"'{escaped}'"


def quote_items(value: str) -> str:
    """Return a list of settings, such as [training.steps=9,skinning.resolution=[8,8,4]], as Hydra reads it: items in quotes.

    Hydra's grammar has no bare = inside of a list. What is no list in brackets, and items in quotes, stay as they are.
    """
    if not (value.startswith("[") and value.endswith("]")):
        return value
    items, depth, inside = [""], 0, ""
    for letter in value[1:-1]:
        if letter == inside:
            inside = ""
        elif not inside and letter in "'\"":
            inside = letter
        depth += 0 if inside else (letter in "[{") - (letter in "]}")
        if letter == "," and not depth and not inside:
            items.append("")
        else:
            items[-1] += letter
    items = [item.strip() for item in items]
    return "[" + ",".join(item if not item or item[0] in "'\"" else quote(item) for item in items) + "]"
