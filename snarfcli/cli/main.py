"""The `snarf` command: flags become Hydra overrides, then Hydra composes the configuration and runs the command."""

from __future__ import annotations

import importlib
import logging
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

import snarfcli
from snarfcli.cli.command_list import COMMAND_LIST, COMMANDS, Command
from snarfcli.cli.messages import user_message
from snarfcli.errors import UserError, nearest
from snarfcli.settings import (
    check_overrides,
    config_folder,
    describe,
    group_options,
    group_schemas,
    in_brackets,
    list_settings,
    preset_groups,
    quote,
    quote_items,
    register_schemas,
)

__all__ = ["COMMANDS", "Command", "main"]

log = logging.getLogger(__name__)

EXIT_USER_ERROR = 2
EXIT_INTERRUPTED = 130

_HYDRA_FLAGS = ("-m", "--multirun", "--cfg", "-c", "--resolve", "--package", "-p", "--info", "-i", "--hydra-help")

# Run folders are the commands' own business: Hydra writes nothing, changes no folder and leaves logging alone.
_HYDRA_SETTINGS = (
    "hydra.run.dir=.",
    "hydra.output_subdir=null",
    "hydra.sweep.dir=outputs/multirun",
    "hydra.sweep.subdir=.",
    "hydra/job_logging=none",
    "hydra/hydra_logging=none",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 1 (partly failed), 2 (a user can mend it) or 130 (Ctrl-C)."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_overview())
        return 0
    if arguments[0] in ("-V", "--version"):
        print(f"snarf {snarfcli.__version__}")
        return 0
    if arguments[0] not in COMMANDS:
        hint = nearest(arguments[0], _shown())
        print(f"snarf: unknown command '{arguments[0]}'{hint}; commands are {', '.join(_shown())}", file=sys.stderr)
        return EXIT_USER_ERROR
    command = COMMANDS[arguments[0]]
    # Before PyTorch is loaded: its threads would otherwise spin for milliseconds after every operation, on the cores that the
    # native library's threads and other processes wait for. Training steps take as long either way.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    _set_up_logging()
    try:
        return _run(command, arguments[1:])
    except KeyboardInterrupt:
        print(f"snarf {command.name}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:  # whoever read the output has seen enough, as in "| head"
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        return _report(command, error)


def _report(command: Command, error: Exception) -> int:
    """Print an error that a user can mend as one line and return its exit code; raise any other again."""
    message = user_message(error)
    if message is None:
        raise error
    print(f"snarf {command.name}: {message}", file=sys.stderr)
    return EXIT_USER_ERROR


def _run(command: Command, arguments: list[str]) -> int:
    """Translate flags, compose the configuration and run the command, once or for every job of a multirun."""
    if any(argument in ("-h", "--help") for argument in arguments):
        print(_help(command))
        return 0
    overrides = _translate_flags(command, arguments)
    module = importlib.import_module(f"snarfcli.commands.{command.module}")
    schema = getattr(module, command.schema)
    if not {"-m", "--multirun"} & set(overrides):  # there, commas are between jobs
        lists = list_settings(schema)
        overrides = [argument if argument.startswith("-") else in_brackets(argument, lists) for argument in overrides]
    settings = [argument for argument in overrides if not argument.startswith("-") and "=" in argument]
    check_overrides(settings, schema, command.name)
    presets = preset_groups(schema, command.name)
    overrides = [_in_group(argument, presets) if argument in settings else argument for argument in overrides]
    register_schemas(command.name, schema)
    codes: list[int] = []

    import hydra
    from omegaconf import OmegaConf

    def job(config: Any) -> None:
        missing = sorted(OmegaConf.missing_keys(config))
        try:
            if missing:
                raise UserError(f"no value for {', '.join(missing)}; give it as {missing[0]}=...")
            codes.append(module.run(OmegaConf.to_object(config)) or 0)
        except Exception as error:  # Hydra would print it in its own way; the next job of a multirun still runs
            codes.append(_report(command, error))

    folder = str(config_folder() / command.folder)
    entry: Callable[[], None] = hydra.main(version_base="1.3", config_path=folder, config_name=command.name)(job)
    # Hydra would print errors of the configuration in its own way and end the process; so it hands them to `main`.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    before = sys.argv
    sys.argv = [f"snarf {command.name}", *_HYDRA_SETTINGS, *overrides]
    try:
        entry()
    finally:
        sys.argv = before
    return max(codes, default=0)


def _translate_flags(command: Command, arguments: list[str]) -> list[str]:
    """Replace the command's flags by overrides; refuse unknown flags and words that are no override.

    Hydra's own flags come last: its parser reads overrides in one run only, not before and after a flag.
    """
    out: list[str] = []
    flags: list[str] = []
    given: set[str] = set()
    written: set[str] = set()
    collected: dict[str, list[str]] = {}
    rest = list(arguments)
    if command.positional and rest and "=" not in rest[0] and not rest[0].startswith(("-", "~")):
        out.append(f"{command.positional}={quote(rest.pop(0))}")
    while rest:
        argument = rest.pop(0)
        name, equals, value = argument.partition("=")
        if name in command.flags:
            override = command.flags[name]
            if "{}" in override:
                if not equals:
                    if not rest:
                        raise UserError(f"{name} needs a value, such as {name} FILE")
                    value = rest.pop(0)
                if "[{}]" in override:
                    collected.setdefault(override, []).append(quote(value))
                    given.add(name)
                    continue
                override = override.format(quote(value))
            elif equals:
                raise UserError(f"{name} takes no value, got {argument!r}")
            if name in given and "{}" in command.flags[name]:
                raise UserError(f"{name} can be given once, got it twice; leave one out")
            given.add(name)
            out.append(override)
        elif name in _HYDRA_FLAGS:
            flags.append(argument)
            if name in ("--cfg", "-c", "--package", "-p", "--info", "-i") and not equals and rest and "=" not in rest[0]:
                flags.append(rest.pop(0))
        elif argument.startswith("-"):
            valid = [*command.flags, "--help", *_HYDRA_FLAGS]
            raise UserError(f'unknown flag {argument!r}{nearest(argument, valid)}; see "snarf {command.name} --help"')
        elif not equals or argument.startswith("~"):
            raise UserError(f'{argument!r} is no setting; write name=value; see "snarf {command.name} --help"')
        else:
            written.add(name)
            out.append(f"{name}={quote_items(value)}" if name in command.lists_of_settings else argument)
    for name in sorted(given):
        setting = command.flags[name].partition("=")[0]
        if setting in written:
            raise UserError(f"{name} and {setting}=... say the same thing; give one of them")
    out += [override.format(",".join(values)) for override, values in collected.items()]
    return out + flags


def _in_group(override: str, presets: dict[str, str]) -> str:
    """Return an override such as experiment=cape as one of the group that holds the presets of the command."""
    name, _, value = override.partition("=")
    return f"{presets.get(name, name)}={value}"


def _shown() -> list[str]:
    """Return the names of the commands that are for people."""
    return [name for name, command in COMMANDS.items() if not command.is_hidden]


def _set_up_logging() -> None:
    """Print the program's own messages plainly on standard output."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stdout)
    logging.getLogger("snarfcli").setLevel(logging.INFO)
    logging.raiseExceptions = False  # a reader that has gone, as in "| head", is no reason to print traces


def _overview() -> str:
    """Return the help of `snarf` itself."""
    rows = "\n".join(f"  {command.name:<12}{command.summary}" for command in COMMAND_LIST if not command.is_hidden)
    return (
        "snarf learns an animatable avatar of one subject from posed meshes.\n\n"
        f"usage: snarf COMMAND [FLAGS] [SETTING=VALUE ...]\n\n{rows}\n\n"
        "Work through the first four in this order; doctor says what this machine has. "
        '"snarf COMMAND --help" tells more, "snarf --version" the version.'
    )


def _help(command: Command) -> str:
    """Return the help of one command: purpose, example, flags, groups and settings."""
    module = importlib.import_module(f"snarfcli.commands.{command.module}")
    schema = getattr(module, command.schema)
    lines = [f"snarf {command.name}: {command.summary}", "", f"example: {command.example}", ""]
    flags = {}
    for flag, override in command.flags.items():
        setting, _, value = override.partition("=")
        times = "; may be given several times" if value == "[{}]" else ""
        flags[f"{flag} VALUE" if "{}" in value else flag] = f"{setting}=VALUE{times}" if "{}" in value else override
    flags["--cfg job"] = "print all settings with their values, and stop"
    flags["-m"] = "a run for each of comma-separated values"
    lines += ["flags:"] + [f"  {flag:<21} {meaning}" for flag, meaning in flags.items()] + [""]
    choices = {name: name for name in group_schemas(schema)} | preset_groups(schema, command.name)
    options = {name: group_options(group) for name, group in choices.items()}
    if any(options.values()):
        lines += ["choices (GROUP=OPTION):"]
        lines += [f"  {name:<21} {', '.join(several)}" for name, several in options.items() if several]
        lines.append("")
    lines += ["settings (NAME=VALUE):"]
    for name, text in describe(schema):
        lines.append(f"  {name:<21} {text}")
    for group, node in group_schemas(schema).items():
        lines += ["", f"settings of {group} ({group}.NAME=VALUE):"]
        lines += [f"  {name:<21} {text}" for name, text in describe(node)]
    return "\n".join(lines)
