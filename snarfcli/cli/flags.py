"""The arguments of a command in Hydra's form: flags such as --pose FILE become overrides such as pose='FILE'."""

from __future__ import annotations

from collections.abc import Sequence

from snarfcli.cli.command_list import Command
from snarfcli.cli.hints import instead_of_argument, instead_of_flag
from snarfcli.errors import UserError
from snarfcli.hydra_config.overrides import quote, quote_items

__all__ = ["translate_flags"]

_HYDRA_FLAGS = ("-m", "--multirun", "--cfg", "-c", "--resolve", "--package", "-p", "--info", "-i", "--hydra-help")
_HYDRA_FLAGS_WITH_VALUE = ("--cfg", "-c", "--package", "-p", "--info", "-i")


def translate_flags(command: Command, arguments: Sequence[str]) -> list[str]:
    """Return the arguments of a command as overrides, followed by Hydra's own flags.

    Raises:
        UserError: a flag is unknown, lacks its value or is given twice, or an argument is no setting.
    """
    return _Arguments(command, arguments).translate()


class _Arguments:
    """The arguments of one call, sorted into overrides and Hydra's own flags."""

    def __init__(self, command: Command, arguments: Sequence[str]) -> None:
        self.command = command
        self.rest = list(arguments)
        self.overrides: list[str] = []
        self.hydra_flags: list[str] = []
        """They come last: Hydra's parser reads overrides in one run, not before and after a flag."""
        self.repeated: dict[str, list[str]] = {}
        """Values of the flags that can be given several times, by the override that takes them."""
        self.given_flags: set[str] = set()
        self.given_settings: set[str] = set()

    def translate(self) -> list[str]:
        self._take_positional()
        while self.rest:
            self._take(self.rest.pop(0))
        for flag in sorted(self.given_flags):
            setting = self.command.flags[flag].partition("=")[0]
            if setting in self.given_settings:
                raise UserError(f"{flag} and {setting}=... set the same value; give one of them")
        lists = [override.format(",".join(values)) for override, values in self.repeated.items()]
        return self.overrides + lists + self.hydra_flags

    def _take_positional(self) -> None:
        """Take a first value without a name, such as table1."""
        if self.command.positional and self.rest and "=" not in self.rest[0] and not self.rest[0].startswith(("-", "~")):
            self.overrides.append(f"{self.command.positional}={quote(self.rest.pop(0))}")

    def _take(self, argument: str) -> None:
        """Take one argument, and the value of a flag that stands behind it."""
        name, equals, value = argument.partition("=")
        if name in self.command.flags:
            self._take_flag(argument, name, value if equals else None)
        elif name in _HYDRA_FLAGS:
            self.hydra_flags.append(argument)
            if name in _HYDRA_FLAGS_WITH_VALUE and not equals and self.rest and "=" not in self.rest[0]:
                self.hydra_flags.append(self.rest.pop(0))
        elif argument.startswith("-"):
            valid = [*self.command.flags, "--help", *_HYDRA_FLAGS]
            hint = instead_of_flag(self.command, argument, self.rest, valid)
            raise UserError(f'unknown flag {argument!r}{hint}; see "snarf {self.command.name} --help"')
        elif not equals or argument.startswith("~"):
            hint = instead_of_argument(self.command, argument)
            raise UserError(f'wanted a setting NAME=VALUE, got {argument!r}{hint}; see "snarf {self.command.name} --help"')
        else:
            self.given_settings.add(name)
            is_list = name in self.command.lists_of_settings
            self.overrides.append(f"{name}={quote_items(value)}" if is_list else argument)

    def _take_flag(self, argument: str, flag: str, value: str | None) -> None:
        """Take one of the command's own flags: without a value, with one, or with one of several."""
        override = self.command.flags[flag]
        if "{}" not in override:
            if value is not None:
                raise UserError(f"{flag}: wanted no value, got {argument!r}; write {flag}")
            self.overrides.append(override)
        else:
            if value is None:
                if not self.rest:
                    raise UserError(f"{flag}: wanted a value, got none; write {flag} VALUE")
                value = self.rest.pop(0)
            if "[{}]" in override:
                self.repeated.setdefault(override, []).append(quote(value))
            elif flag in self.given_flags:
                raise UserError(f"{flag}: wanted it once, got it twice; leave one out")
            else:
                self.overrides.append(override.format(quote(value)))
        self.given_flags.add(flag)
