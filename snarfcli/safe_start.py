"""Start Python processes that import nothing from the current folder.

DESIGN. With `-c` and `-m`, Python looks for modules in the current folder first: a file signal.py that came with a download
would run in every process that is started there. From Python 3.11 on, PYTHONSAFEPATH prevents this. Python 3.10 has no such
option; there, code that needs only the built-in module sys drops the folder before anything is imported. Folders in the user's
own PYTHONPATH stay.
"""

from __future__ import annotations

import contextlib
import multiprocessing.util
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

__all__ = ["safe_environment", "safe_imports", "snarf_command"]

_VARIABLE = "PYTHONSAFEPATH"
_KNOWS_VARIABLE = sys.version_info >= (3, 11)
_DROP_FOLDER = "import sys; sys.path[:] = filter(None, sys.path)"  # the current folder is the empty text


def snarf_command(arguments: Sequence[str]) -> list[str]:
    """Return the command line of a `snarf` process with arguments; start it with `safe_environment`."""
    package = str(Path(__file__).absolute().parents[1])  # last, for a checkout that is not installed
    start = f"{_DROP_FOLDER}; sys.path.append({package!r}); from snarfcli.cli.main import main; raise SystemExit(main())"
    return [sys.executable, "-c", start, *arguments]


def safe_environment() -> dict[str, str]:
    """Return the environment of this process, with which Python processes import nothing from the current folder.

    So do the processes that they start, such as those of joblib and submitit. Python 3.10 ignores it.
    """
    return {**os.environ, _VARIABLE: "1"}


@contextlib.contextmanager
def safe_imports() -> Iterator[None]:
    """Start processes of `multiprocessing` that import nothing from the current folder."""
    if not _KNOWS_VARIABLE:
        with _drop_folder_first():
            yield
        return
    before = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = before


@contextlib.contextmanager
def _drop_folder_first() -> Iterator[None]:
    """Start processes of `multiprocessing` with code that drops the current folder, then runs the code that was wanted.

    `multiprocessing` writes `python OPTIONS -c CODE ...` and has no setting for the options.
    """
    util: Any = multiprocessing.util  # the name is private; Python 3.10 no longer changes
    original = util._args_from_interpreter_flags
    run_wanted = f"{_DROP_FOLDER}; del sys.argv[1]; exec(sys.argv.pop(1))"  # sys.argv is -c, -c, CODE, ...
    util._args_from_interpreter_flags = lambda: [*original(), "-c", run_wanted]
    try:
        yield
    finally:
        util._args_from_interpreter_flags = original
