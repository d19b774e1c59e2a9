"""What to write in place of an argument that is no setting: a setting with dashes, a flag without them, or a file."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from pathlib import Path

from snarfcli.cli.command_list import Command
from snarfcli.errors import nearest
from snarfcli.hydra_config.source_schema import SourceSchema, read_schema
from snarfcli.texts import one_line

__all__ = ["instead_of_argument", "instead_of_flag"]

_RIGGED = (".glb", ".gltf", ".vrm")
"""Suffixes of files that can be a subject. (The list of the data sets cannot be imported without PyTorch.)"""
_LONGEST = 200  # characters of an argument in a message


def instead_of_flag(command: Command, argument: str, rest: Sequence[str], flags: Sequence[str]) -> str:
    """Return what to write in place of an unknown flag: the setting of this name, or the most similar flag.

    Args:
        command: the command.
        argument: the flag, perhaps with =VALUE.
        rest: the arguments behind it.
        flags: all flags that exist.

    Returns:
        A part of a message that begins with a semicolon, or nothing.
    """
    flag, equals, value = argument.partition("=")
    name = flag.lstrip("-").replace("-", "_")
    schema = _schema(command)
    group, _, nested = name.partition(".")
    if name in schema.texts or (group in schema.groups and nested in schema.groups[group].texts):
        found = name
    else:
        found = next((f"{group}.{name}" for group in _groups_with(schema, name)), None)
    if found is None:
        return nearest(argument, flags)
    if not equals:
        value = rest[0] if rest and not rest[0].startswith("-") and "=" not in rest[0] else "VALUE"
    return f"; settings have no dashes: write {_setting(found, value)}"


def instead_of_argument(command: Command, argument: str) -> str:
    """Return what to write in place of an argument without a name: a flag, or the setting that takes such a file.

    Returns:
        A part of a message that begins with a semicolon, or nothing.
    """
    if f"--{argument}" in command.flags:
        return f"; write --{argument}"
    path = Path(argument)
    if not path.suffix or argument.startswith("~"):
        return ""
    schema = _schema(command)
    if path.suffix.lower() in _RIGGED and "pose" not in schema.texts and {"data", "subject"} <= schema.texts.keys():
        folder = _setting("data.folder", str(path.parent))
        return f"; for a rigged file, write data=meshes {folder} {_setting('subject', path.stem)}"
    if "--pose" in command.flags and os.path.exists(argument):
        return f"; for a motion file, write --pose {shlex.quote(one_line(argument, _LONGEST))}"
    return ""


def _schema(command: Command) -> SourceSchema:
    return read_schema(f"snarfcli.commands.{command.module}", command.schema)


def _groups_with(schema: SourceSchema, name: str) -> list[str]:
    """Return the groups of settings that have a setting of this name; none if it is ambiguous."""
    groups = [group for group, nested in schema.groups.items() if name in nested.texts]
    return groups if len(groups) == 1 else []


def _setting(name: str, value: str) -> str:
    """Return a setting as it is written in a shell."""
    return shlex.quote(f"{name}={one_line(value, _LONGEST)}")
