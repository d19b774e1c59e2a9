"""The page of the configuration: every setting of every command, from the dataclasses and the yaml files in conf/."""

from __future__ import annotations

import dataclasses
import importlib
import json
import re
import typing
from collections.abc import Iterable, Iterator
from html import escape
from typing import Any

from snarfcli.cli.command_list import COMMAND_LIST, Command
from snarfcli.hydra_config.schema import (
    config_folder,
    describe,
    group_options,
    group_schemas,
    preset_groups,
    register_schemas,
)

__all__ = ["configuration_page"]

_START = """# Configuration

Every setting of every command, made from the dataclasses and the files in `conf/`. Give settings as `NAME=VALUE`, such as
`training.steps=500`, and choices as `GROUP=OPTION`, such as `training=quick`; they are overrides of [Hydra](https://hydra.cc).
`snarf COMMAND --cfg job` prints the values that a call would use. `???` has no default and must be given.
"""


def configuration_page() -> str:
    """Return the page as Markdown: the commands with their own settings, then the groups with the values of each option."""
    parts, groups = [_START], dict[str, tuple[Command, type]]()
    for command in COMMAND_LIST:
        if not command.is_hidden:
            schema = _schema(command)
            parts += _command_section(command, schema)
            for group, kind in group_schemas(schema).items():
                if group_options(group):
                    groups.setdefault(group, (command, kind))
    for group, (command, kind) in groups.items():
        parts += _group_section(group, kind, command)
    return "\n".join(parts) + "\n"


def _schema(command: Command) -> type:
    return getattr(importlib.import_module(f"snarfcli.commands.{command.module}"), command.schema)


def _command_section(command: Command, schema: type) -> list[str]:
    """Return the section of a command: its own settings, and those of groups without options."""
    values = _compose(command, schema, [])
    lines = ["", f"## snarf {command.name}", "", f"{_sentence(command.summary)} Example: `{command.example}`", ""]
    nested = group_schemas(schema)
    choices = [f"[`{group}`](#{group})" for group in nested if group_options(group)]
    presets = [
        f"`{name}` ({', '.join(f'`{option}`' for option in group_options(group))})"
        for name, group in preset_groups(schema, command.name).items()
    ]
    if choices:
        lines += [f"Groups with options of their own: {', '.join(choices)}.", ""]
    if presets:
        lines += [f"Presets for several settings: {', '.join(presets)}.", ""]
    lines += _table(["setting", "type", "default", "description"], _rows(schema, "", [values]))
    for group, kind in nested.items():
        if not group_options(group):
            rows = _rows(kind, f"{group}.", [values.get(group) or {}])
            lines += ["", *_table(["setting", "type", "default", "description"], rows)]
    return lines


def _group_section(group: str, kind: type, command: Command) -> list[str]:
    """Return the section of a group: its settings with their values in every option."""
    schema, options = _schema(command), group_options(group)
    columns = [_compose(command, schema, [f"{group}={option}"]).get(group) or {} for option in options]
    summary = [f"- `{group}={option}`: {_comment(group, option)}" for option in options]
    lines = ["", f"## {group}", "", *summary, ""]
    return lines + _table(
        ["setting", "type", *(f"`{one}`" for one in options), "description"], _rows(kind, f"{group}.", columns)
    )


def _rows(kind: type, prefix: str, columns: list[dict[str, Any]]) -> Iterator[list[str]]:
    """Yield name, type, values and description of each setting of a dataclass that is no group."""
    hints = typing.get_type_hints(kind)
    for name, text in describe(kind):
        values = [_value(column.get(name, _default(kind, name))) for column in columns]
        yield [f"`{prefix}{name}`", _type(hints[name]), *values, _cell(text)]


def _default(kind: type, name: str) -> Any:
    (field,) = [one for one in dataclasses.fields(kind) if one.name == name]
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return "???" if field.default is dataclasses.MISSING else field.default


def _table(head: list[str], rows: Iterable[list[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def _type(hint: Any) -> str:
    """Return a type as it is written, without the names of modules."""
    text = hint.__name__ if isinstance(hint, type) and not typing.get_args(hint) else str(hint)
    return f"`{re.sub(r'(?:[a-z_]+[.])+', '', text).replace(' | ', ' or ')}`"


def _value(value: Any) -> str:
    """Return a value as it is written on the command line."""
    if value is None or value == "" or isinstance(value, bool):
        return f"`{json.dumps(value)}`"
    return f"`{str(value).replace(' ', '')}`" if isinstance(value, list) else f"`{value}`"


def _cell(text: str) -> str:
    """Return a plain text in a cell of a table."""
    return escape(text, quote=False).replace("|", "&#124;").replace("*", r"\*")


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"


def _comment(group: str, option: str) -> str:
    """Return the comment at the start of an option's file."""
    lines: list[str] = []
    for line in (config_folder() / group / f"{option}.yaml").read_text("utf-8").splitlines():
        if not line.startswith("#"):
            break
        if "@package" not in line:
            lines.append(line.lstrip("# "))
    return " ".join(lines)


def _compose(command: Command, schema: type, overrides: list[str]) -> dict[str, Any]:
    """Return the configuration of a command as the command line would compose it, with values as they are written."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    register_schemas(command.name, schema)
    with initialize_config_dir(str(config_folder() / command.folder), version_base="1.3"):
        values: Any = OmegaConf.to_container(compose(command.name, overrides))
    return values
