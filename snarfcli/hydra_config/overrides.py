"""Overrides such as `training.steps=9`: checks against the dataclasses of a command, and quoting for Hydra's grammar.

Imports of Hydra stand inside functions: it takes a third of a second, which --help does not need.
"""

from __future__ import annotations

import re
import typing
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

from snarfcli.errors import UserError, nearest
from snarfcli.hydra_config.schema import group_options, group_schemas, preset_groups, setting_names
from snarfcli.texts import one_line

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override

__all__ = ["check_overrides", "quote", "quote_items", "readable"]

# What is meant for Hydra: a quoted text, a mapping, or a function such as range(1,4).
_DELIBERATE = re.compile(
    r"['\"]|\{.*\}$|(?:bool|choice|extend_list|float|glob|int|interval|json_str|range|shuffle|sort|str|tag)\(", re.DOTALL
)


def check_overrides(overrides: Sequence[str], schema: type, command: str = "") -> None:
    """Check that overrides name settings of a command, and options that its choices have.

    Args:
        overrides: NAME=VALUE each.
        schema: the command's dataclass.
        command: name of the command, for its presets.

    Raises:
        UserError: an override does not; the message suggests the most similar name.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser = OverridesParser.create()
    names = setting_names(schema)
    groups = {name: name for name in group_schemas(schema)} | preset_groups(schema, command)
    optional = {name for name, hint in typing.get_type_hints(schema).items() if type(None) in typing.get_args(hint)}
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
        if group != key and group in optional and not any(other.startswith(f"{group}=") for other in overrides):
            known = ", ".join(f"{group}={option}" for option in group_options(group))
            raise UserError(f"{key}: wanted a choice of {group} too; add one of {known} (a run has its own in config.yaml)")
        if key in groups:
            _check_options(override, group_options(groups[key]), is_optional=key in optional)


def _check_options(override: Override, options: Sequence[str], is_optional: bool) -> None:
    """Check that a configuration group has the option, or for a sweep all options, that an override chooses."""
    key = override.key_or_group
    left_out = ", or leave it out" if is_optional else ""
    for value in _values(override):
        option = "null" if value is None else str(value)
        if option not in options:
            near = nearest(option, options)
            raise UserError(f"there is no {key}={option}{near}; choose from {', '.join(options)}{left_out}")


def _values(override: Override) -> list[Any]:
    """Return the value of an override, or all values of a sweep."""
    if override.is_sweep_override():
        return [str(value).strip("'\"") for value in override.sweep_string_iterator()]
    return [override.value()]


def readable(override: str, lists: Collection[str], is_multirun: bool = False) -> str:
    """Return an override as Hydra's grammar reads it: lists in brackets, and values in quotes that it would refuse.

    The grammar knows few characters outside quotes: no letters but A to Z, no parentheses, no ~ and others. Texts that look
    like a quoted text, a mapping or one of Hydra's functions stay as they are.

    Args:
        override: NAME=VALUE.
        lists: names of the settings that are lists; views=front,left becomes views=[front,left].
        is_multirun: whether commas separate jobs, instead of the items of a list.
    """
    name, _, value = override.partition("=")
    if is_multirun:
        values = [_readable_value(one) for one in _split(value)]
        return override if _is_readable(value) else f"{name}={','.join(values)}"
    if name in lists:
        value = value if value in ("", "null") or _is_list(value) or "${" in value else f"[{value}]"
    return f"{name}={_readable_value(value)}"


def _readable_value(value: str) -> str:
    """Return one value, or a list, as Hydra's grammar reads it."""
    if _is_readable(value) or _DELIBERATE.match(value):
        return value
    if _is_list(value):
        return "[" + ",".join(one if _is_readable(f"[{one}]") else _readable_value(one) for one in _split(value[1:-1])) + "]"
    return quote(value)


def _is_readable(value: str) -> bool:
    """Return whether Hydra's grammar reads a value."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        OverridesParser.create().parse_override(f"name={value}")
    except HydraException:
        return False
    return True


def _is_list(value: str) -> bool:
    return value.startswith("[") and value.endswith("]")


def _split(text: str) -> list[str]:
    """Return the parts of a text between commas; those in quotes, brackets or braces separate nothing."""
    parts, depth, open_quote, before = [""], 0, "", ""
    for index, letter in enumerate(text):
        if letter == open_quote and before != "\\":
            open_quote = ""
        elif not open_quote and letter in "'\"" and letter in text[index + 1 :]:  # it's has an apostrophe
            open_quote = letter
        depth += 0 if open_quote else (letter in "[{") - (letter in "]}")
        if letter == "," and not depth and not open_quote:
            parts.append("")
        else:
            parts[-1] += letter
        before = letter
    return [part.strip() for part in parts]


def quote(value: str) -> str:
    """Return a value in quotes, so that Hydra's grammar reads back the same text, for any characters."""
    # Within quotes only a quote is special, and so are the backslashes that lead up to one.
    escaped = re.sub(r"(\\*)('|$)", lambda match: match.group(1) * 2 + ("\\'" if match.group(2) else ""), value)
    return f"'{escaped}'"


def quote_items(value: str) -> str:
    """Return a list of settings, such as [training.steps=9,skinning.resolution=[8,8,4]], with its items in quotes.

    Hydra's grammar allows no bare = inside a list. A value without brackets, and items in quotes, stay as they are.
    """
    if not _is_list(value):
        return value
    items = _split(value[1:-1])
    return "[" + ",".join(item if not item or item[0] in "'\"" else quote(item) for item in items) + "]"
