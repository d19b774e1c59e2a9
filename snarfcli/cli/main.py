"""The `snarf` command: flags become Hydra overrides, then Hydra composes the configuration and runs the command."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

import snarfcli
from snarfcli.cli.command_list import COMMANDS, Command
from snarfcli.cli.flags import translate_flags
from snarfcli.cli.help import command_help, overview
from snarfcli.cli.messages import user_message
from snarfcli.cli.start import start_page
from snarfcli.cli.terminal import (
    abandon_output,
    escape_what_cannot_be_shown,
    output_failure,
    print_error,
    set_up_output,
)
from snarfcli.errors import UserError, nearest
from snarfcli.hydra_config.home import expand_home
from snarfcli.hydra_config.overrides import check_overrides, readable
from snarfcli.hydra_config.schema import config_folder, list_settings, preset_groups, register_schemas
from snarfcli.interrupts import exit_code, signals_as_interrupts

__all__ = ["COMMANDS", "Command", "main"]

EXIT_USER_ERROR = 2

# The commands create their run folders themselves: Hydra writes nothing, changes no folder and leaves logging alone.
_HYDRA_SETTINGS = (
    "hydra.run.dir=.",
    "hydra.output_subdir=null",
    "hydra.sweep.dir=outputs/multirun",
    "hydra.sweep.subdir=.",
    "hydra/job_logging=none",
    "hydra/hydra_logging=none",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Returns:
        0, 1 (partly failed), 2 (user error), 130 (Ctrl-C), 143 (SIGTERM) or 129 (SIGHUP).
    """
    _open_standard_streams()
    escape_what_cannot_be_shown()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if not arguments:
        return _print(start_page())
    if arguments[0] in ("-h", "--help", "help"):
        return _print(overview())
    if arguments[0] in ("-V", "--version"):
        return _print(f"snarf {snarfcli.__version__}")
    if arguments[0] not in COMMANDS:
        hint = nearest(arguments[0], _shown())
        print_error(f"snarf: unknown command '{arguments[0]}'{hint}; commands are {', '.join(_shown())}")
        return EXIT_USER_ERROR
    command = COMMANDS[arguments[0]]
    # Set before PyTorch is loaded: its threads would otherwise spin for milliseconds after every operation, on cores that the
    # threads of the native library and other processes need. Training steps take equally long with and without it.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    set_up_output()
    try:
        with signals_as_interrupts():
            code = _run(command, arguments[1:])
        return code or _check_output(command.name)
    except KeyboardInterrupt as interrupt:
        print_error(f"snarf {command.name}: interrupted")
        return exit_code(interrupt)
    except BrokenPipeError:  # the reader of the output has ended, as in "| head"
        abandon_output()
        return 0
    except Exception as error:
        return _report(command, error)


def _print(text: str) -> int:
    """Print a text on standard output and return the exit code."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        abandon_output()
    except OSError as error:
        abandon_output()
        print_error(f"snarf: standard output: {error.strerror}; free some space, or write elsewhere")
        return EXIT_USER_ERROR
    return 0


def _check_output(command: str) -> int:
    """Return the exit code of a command that has succeeded: an error if what it printed is lost, as on a full disk."""
    reason = output_failure()
    if reason is None:
        return 0
    abandon_output()
    print_error(f"snarf {command}: standard output: {reason}; all files are written, but what it printed is lost")
    return EXIT_USER_ERROR


def _report(command: Command, error: Exception) -> int:
    """Print a user error as one line and return its exit code; raise any other error again."""
    message = user_message(error)
    if message is None:
        raise error
    print_error(f"snarf {command.name}: {message}")
    return EXIT_USER_ERROR


def _open_standard_streams() -> None:
    """Open the null device in place of standard streams that are closed, as services do and `2>&-` does.

    The next file to be opened would otherwise get the number of such a stream, and what libraries print would go into it.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115 - stays open as long as the process


def _run(command: Command, arguments: list[str]) -> int:
    """Run one command, once or for every job of a multirun, and return its exit code."""
    if any(argument in ("-h", "--help") for argument in arguments):
        print(command_help(command))
        return 0
    overrides = translate_flags(command, arguments)
    module = importlib.import_module(f"snarfcli.commands.{command.module}")
    schema = getattr(module, command.schema)
    overrides = _checked(overrides, schema, command.name)
    register_schemas(command.name, schema)
    return _run_in_hydra(command, module.run, overrides)


def _checked(overrides: list[str], schema: type, command: str) -> list[str]:
    """Check the overrides of a command and return them as Hydra reads them, presets with their group."""
    lists, is_multirun = list_settings(schema), bool({"-m", "--multirun"} & set(overrides))
    overrides = [readable(one, lists, is_multirun) if "=" in one and not one.startswith("-") else one for one in overrides]
    settings = [argument for argument in overrides if not argument.startswith("-") and "=" in argument]
    check_overrides(settings, schema, command)
    presets = preset_groups(schema, command)
    return [_in_group(argument, presets) if argument in settings else argument for argument in overrides]


def _in_group(override: str, presets: dict[str, str]) -> str:
    """Return an override such as experiment=cape with the group of the command's presets: experiment/train=cape."""
    name, _, value = override.partition("=")
    return f"{presets.get(name, name)}={value}"


def _run_in_hydra(command: Command, run: Callable[[Any], int | None], overrides: list[str]) -> int:
    """Compose the configuration of every job, run them, and return the highest exit code."""
    import hydra  # Hydra takes a third of a second, which --help does not need
    from omegaconf import OmegaConf

    from snarfcli.cli.multirun import NOTE_FOLDER, ExitCodes, lost_job, slot_of_job
    from snarfcli.hydra_config.help_texts import lazy_help_texts

    codes = ExitCodes()

    def job(config: Any) -> None:
        missing = sorted(OmegaConf.missing_keys(config))
        try:
            if missing:
                raise UserError(f"{', '.join(missing)}: wanted a value, got none; give {missing[0]}=VALUE")
            with slot_of_job():
                code = run(expand_home(OmegaConf.to_object(config))) or 0
        except Exception as error:  # reported here, not by Hydra; the next job of a multirun still runs
            code = _report(command, error)
        codes.add(code)

    folder = str(config_folder() / command.folder)
    entry: Callable[[], None] = hydra.main(version_base="1.3", config_path=folder, config_name=command.name)(job)
    # Makes Hydra raise errors of the configuration, which `main` reports, instead of printing them and ending the process.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    before = sys.argv
    sys.argv = [f"snarf {command.name}", *_HYDRA_SETTINGS, NOTE_FOLDER, *overrides]
    try:
        with lazy_help_texts():
            entry()
    except Exception as error:
        if (lost := lost_job(error)) is not None:
            raise UserError(lost) from error
        raise
    finally:
        sys.argv = before
        failure = codes.collect()
    if failure:
        print_error(f"snarf {command.name}: {failure}")
    return codes.highest()


def _shown() -> list[str]:
    """Return the names of the commands that the help lists."""
    return [name for name, command in COMMANDS.items() if not command.is_hidden]
