"""User errors as one line each."""

from __future__ import annotations

import errno
import re
import sys

from snarfcli.errors import LOST_DRIVE, UserError, is_out_of_memory, nearest
from snarfcli.hydra_config.launchers import PLUGIN_LAUNCHERS, missing_plugin
from snarfcli.texts import one_line

__all__ = ["user_message"]


_LONGEST = 2000  # characters; names in a file can be of any length


def user_message(error: BaseException) -> str | None:
    """Return one line of bounded length for a user error, or None for a fault of the program."""
    message = _message(error)
    if message is None:
        return None
    line = one_line(message)
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 3]}..."


def _message(error: BaseException) -> str | None:
    chain = _chain(error)
    for link in chain:
        if isinstance(link, UserError):
            return one_line(link)  # the name of its type, if it has no message
    if "hydra" in sys.modules and (option := _option_message(chain)):
        return option
    for link in chain:
        if isinstance(link, OSError) and not isinstance(link, (ConnectionError, ChildProcessError)):
            return _file_message(link)
        if is_out_of_memory(link):
            return _memory_message(link)
    if "hydra" not in sys.modules:
        return None  # nor any of its errors
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    return _config_message(chain) if isinstance(error, OmegaConfBaseException | HydraException) else None


_NO_PERMISSION = "no permission; change its permissions, or name another place (output_root=..., data_root=... or output=...)"


def _chain(error: BaseException) -> list[BaseException]:
    """Return the error and its causes."""
    links: list[BaseException] = []
    current: BaseException | None = error
    while current is not None and current not in links:
        links.append(current)
        current = current.__cause__ or current.__context__
    return links


def _file_message(error: OSError) -> str:
    """Return what went wrong with a file, and the next step."""
    name = error.filename2 or error.filename or "a file"
    advice = dict.fromkeys(LOST_DRIVE, "the network drive does not answer; try again when it does") | {
        errno.ENOSPC: "the disk is full; free some space, then run the command again: it continues where it stopped",
        errno.EDQUOT: "the disk quota is used up; free some space, then run the command again",
        errno.EACCES: _NO_PERMISSION,
        errno.EPERM: _NO_PERMISSION,
        errno.EMFILE: "too many open files; raise the limit with `ulimit -n`",
        errno.ENFILE: "too many open files on this machine; close other programs",
        errno.ENOMEM: "not enough memory; close other programs",
        errno.EIO: "the disk reports an error; the file itself may be whole; check the disk, or copy the folder to another one",
        errno.ESTALE: "the network drive lost it; try again",
        errno.EROFS: "the file system is read-only; choose another place with output_root=..., data_root=... or output=...",
        errno.EFBIG: "larger than the file system or a limit (`ulimit -f`) allows; raise the limit, or choose another place",
        errno.ENOTDIR: "part of the path is a file, not a folder; choose another folder",
        errno.EISDIR: "is a folder, not a file",
        errno.EEXIST: "is a file, not a folder; choose another folder",
        errno.ENOENT: "does not exist and cannot be created; choose another folder or file",
    }
    return f"{name}: {advice.get(error.errno or 0, error.strerror or one_line(error))}"


def _memory_message(error: BaseException) -> str:
    """Return what needed too much memory, if it is known, and the next step."""
    if "CUDA" in str(error):
        return "not enough memory on the GPU; end other programs that use it, choose smaller sizes, or give device=cpu"
    own = one_line(error, 300) if isinstance(error, MemoryError) and str(error) else ""
    return own if ";" in own else "not enough memory; close other programs, or choose smaller sizes"


def _option_message(chain: list[BaseException]) -> str | None:
    """Return one line for an option that a group of Hydra lacks, such as hydra/launcher=NAME; None for other errors."""
    from hydra.errors import MissingConfigException

    for link in chain:
        if isinstance(link, MissingConfigException):
            group, _, option = str(link.missing_cfg_file).rpartition("/")
            known = set(link.options or ())
            if group == "hydra/launcher":
                if (what_to_install := missing_plugin(option, group)) is not None:
                    return what_to_install
                known |= {*PLUGIN_LAUNCHERS}
            return f"there is no {group}={option}{nearest(option, known)}; choose from {', '.join(sorted(known))}"
    return None


def _config_message(chain: list[BaseException]) -> str:
    """Return one line for a setting whose value has the wrong type."""
    text = " ".join(one_line(link) for link in chain)
    unfit = re.search(r"Value '([^']*)'.*? (?:could not be converted to|is not a valid) (\w+)", text)
    key = re.search(r"full_key: ([\w.]+)", text)
    if unfit and key:
        return f"{key.group(1)}: wanted {_TYPE_NAMES.get(unfit.group(2), unfit.group(2))}, got '{unfit.group(1)}'"
    several = re.search(r"override (\S+?)=(\S*).*Cannot convert 'list' to string", text)
    if several:
        one = several.group(2).strip("[]':").split(",")[0]
        return f"{several.group(1)}: wanted one value, got a list; write {several.group(1)}={one}"
    single = re.search(r"override (\S+?)=(\S*).*is not a ListConfig", text)
    if single:
        return f"{single.group(1)}: wanted a list, got {single.group(2)}; write {single.group(1)}=[{single.group(2)}]"
    ambiguous = re.search(r"Ambiguous value for argument '(\S+?)=(.*?)'(?: 1\.|$)", text)
    if ambiguous:
        name, value = ambiguous.groups()
        one_name = f"""{name}='"{value}"'"""
        return f"{name}: wanted one value, got {value}; give -m for one run per value, or {one_name} for a name with a comma"
    lines = dict.fromkeys(" ".join(str(link).strip().splitlines()[0].split()) for link in chain if str(link).strip())
    return ": ".join(list(lines)[:2])


_TYPE_NAMES = {
    "Integer": "a whole number",
    "Float": "a number",
    "Boolean": "true or false",
    "bool": "true or false",
    "String": "a text",
}
