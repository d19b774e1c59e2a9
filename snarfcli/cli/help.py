"""The help texts: the overview of `snarf`, and the help of one command."""

from __future__ import annotations

from snarfcli.cli.command_list import COMMAND_LIST, Command
from snarfcli.hydra_config.schema import group_options, preset_groups_among
from snarfcli.hydra_config.source_schema import read_schema

__all__ = ["command_help", "overview"]


def overview() -> str:
    """Return the help of `snarf` itself."""
    rows = "\n".join(f"  {command.name:<12}{command.summary}" for command in COMMAND_LIST if not command.is_hidden)
    return (
        "snarf learns an animatable avatar of one subject from posed meshes.\n\n"
        f"usage: snarf COMMAND [FLAGS] [SETTING=VALUE ...]\n\n{rows}\n\n"
        "Run preprocess, train, eval and animate in this order, and before them fit for scans without poses; "
        '"snarf doctor" checks the installation.\n'
        '"snarf COMMAND --help" lists the settings of a command, "snarf --version" prints the version.'
    )


def command_help(command: Command) -> str:
    """Return the help of one command: purpose, example, flags, choices and settings."""
    schema = read_schema(f"snarfcli.commands.{command.module}", command.schema)
    lines = [f"snarf {command.name}: {command.summary}", "", f"example: {command.example}"]
    lines += _section("flags", _flags(command))
    choices = {name: name for name in schema.groups} | preset_groups_among(schema.texts, command.name)
    options = {name: ", ".join(group_options(group)) for name, group in choices.items()}
    lines += _section("choices (GROUP=OPTION)", {name: several for name, several in options.items() if several})
    lines += _section("settings (NAME=VALUE)", schema.settings())
    for group, node in schema.groups.items():
        lines += _section(f"settings of {group} ({group}.NAME=VALUE)", node.settings())
    return "\n".join(lines)


def _flags(command: Command) -> dict[str, str]:
    """Return the flags of a command, and what each stands for."""
    flags: dict[str, str] = {}
    for flag, override in command.flags.items():
        setting, _, value = override.partition("=")
        repeated = "; can be given several times" if value == "[{}]" else ""
        if "{}" in value:
            flags[f"{flag} VALUE"] = f"{setting}=VALUE{repeated}"
        else:
            flags[flag] = override
    return flags | {
        "--cfg job": "print all settings with their values and stop",
        "-m": "one run per combination of comma-separated values",
    }


def _section(title: str, rows: dict[str, str]) -> list[str]:
    """Return the lines of a section of the help, or none if it has no rows."""
    return ["", f"{title}:"] + [f"  {name:<21} {text}" for name, text in rows.items()] if rows else []
