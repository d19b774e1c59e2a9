"""The dataclasses of a command as Hydra's schemas, their descriptions, and the choices in conf/.

Imports of Hydra stand inside functions: it takes a third of a second, which --help does not need.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path

from snarfcli.field_docs import field_texts

__all__ = [
    "config_folder",
    "describe",
    "group_options",
    "group_schemas",
    "list_settings",
    "preset_groups",
    "preset_groups_among",
    "register_schemas",
    "setting_names",
]


def config_folder() -> Path:
    """Return the folder with the yaml files: inside the package when installed, at the top of a checkout otherwise."""
    package = Path(__file__).parents[1]
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


def preset_groups(schema: type, command: str) -> dict[str, str]:
    """Return the fields of a command's dataclass that choose a preset, with the configuration group of each."""
    return preset_groups_among([field.name for field in dataclasses.fields(schema)], command)


def preset_groups_among(names: Iterable[str], command: str) -> dict[str, str]:
    """Return those of a command's fields that choose a preset, with the configuration group of each.

    The group is the folder `<field>/<command>` in conf/, such as experiment/train.
    """
    groups = {name: f"{name}/{command}" for name in names}
    return {name: group for name, group in groups.items() if (config_folder() / group).is_dir()}


def group_options(group: str) -> list[str]:
    """Return the options of a configuration group, such as complete and broyden for `search`."""
    return sorted(path.stem for path in (config_folder() / group).glob("*.yaml"))


def group_schemas(schema: type) -> dict[str, type]:
    """Return the fields of a dataclass whose type is a dataclass (or a dataclass or None), with that dataclass."""
    hints = typing.get_type_hints(schema)
    found: dict[str, type] = {}
    for field in dataclasses.fields(schema):
        for kind in typing.get_args(hints[field.name]) or (hints[field.name],):
            if isinstance(kind, type) and dataclasses.is_dataclass(kind):
                found[field.name] = kind
    return found


def register_schemas(name: str, schema: type) -> None:
    """Put the dataclass of a command, and those of its fields, into Hydra's store as `schema/...`."""
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance()
    store.store(group="schema", name=name, node=schema)
    for group, node in group_schemas(schema).items():
        store.store(group="schema", name=group, node=node)


def describe(schema: type) -> Iterator[tuple[str, str]]:
    """Yield name and docstring of each field of a dataclass; base classes first, fields that are dataclasses left out."""
    texts, nested = field_texts(schema), group_schemas(schema)
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
    """Return the dotted names of all settings of a dataclass whose type is a list (or a list or None)."""
    nested, hints = group_schemas(schema), typing.get_type_hints(schema)
    names: set[str] = set()
    for field in dataclasses.fields(schema):
        kinds = (hints[field.name], *typing.get_args(hints[field.name]))
        if any(typing.get_origin(kind) is list for kind in kinds):
            names.add(prefix + field.name)
        elif field.name in nested:
            names |= list_settings(nested[field.name], f"{prefix}{field.name}.")
    return names
