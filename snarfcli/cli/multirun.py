"""Jobs of `-m`: their exit codes, also from other processes and machines, and the GPU that each of them uses.

This imports Hydra, which takes a third of a second.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import snarfcli.extras.commands  # noqa: F401 - raises MissingPackage

# isort: split
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode

from snarfcli.locks import hold_slot
from snarfcli.slots import SLOT_VARIABLE, use_slot
from snarfcli.texts import one_line

__all__ = ["NOTE_FOLDER", "ExitCodes", "SweepFolder", "lost_job", "slot_of_job"]

NOTE_FOLDER = f"+hydra.callbacks.snarf._target_={__name__}.SweepFolder"
"""Setting of Hydra by which `SweepFolder` is told the folder."""


class SweepFolder(Callback):
    """Records the folder of a multirun, which the processes and machines of all its jobs can write to."""

    path: ClassVar[Path | None] = None
    """The folder of the multirun that this process has started last."""
    output: ClassVar[str | None] = None
    """Where its launcher keeps what jobs print; None if they print as this process does."""

    def on_multirun_start(self, config: Any, **more: Any) -> None:
        """Record the folder; called by Hydra."""
        SweepFolder.path = Path(config.hydra.sweep.dir)
        kept = config.hydra.launcher.get("submitit_folder")
        SweepFolder.output = None if kept is None else str(Path(kept).parent)


class ExitCodes:
    """Exit codes of the jobs of one call.

    Launchers such as joblib run the jobs with copies of this object in other processes. A copy writes its codes to files in
    the folder of the multirun.
    """

    def __init__(self, copy_of: str | None = None) -> None:
        self._is_copy = copy_of is not None
        self._name = copy_of or f".codes-{secrets.token_hex(4)}"
        self._codes: list[int] = []

    def __reduce__(self) -> tuple[Any, ...]:
        return ExitCodes, (self._name,)

    def add(self, code: int) -> None:
        """Add the exit code of the job that runs.

        Raises:
            OSError: it cannot be written. Hydra passes this on to the process of the call.
        """
        if not self._is_copy:
            self._codes.append(code)
            return
        hydra = HydraConfig.get()
        folder = Path(hydra.sweep.dir) / self._name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / str(hydra.job.num)).write_text(str(code))

    def collect(self) -> str | None:
        """Add the codes from other processes, and delete their files.

        Returns:
            How many of those jobs have failed, if any.
        """
        if SweepFolder.path is None:
            return None
        folder = SweepFolder.path / self._name
        codes = [int(path.read_text() or 1) for path in folder.glob("[0-9]*")]
        shutil.rmtree(folder, ignore_errors=True)
        self._codes += codes
        failed = sum(code != 0 for code in codes)
        where = f"; what they printed is in {SweepFolder.output}" if SweepFolder.output else ""
        return f"{failed} of {len(codes)} jobs failed{where}" if failed else None

    def highest(self) -> int:
        """Return the highest code; 0 without any."""
        return max(self._codes, default=0)


def lost_job(error: Exception) -> str | None:
    """Return one line for an error of a launcher whose job has ended without a result; None for other errors."""
    if type(error).__module__.partition(".")[0] not in ("joblib", "submitit"):
        return None
    why = one_line(str(error).partition("\n")[0], 300)
    return f"hydra/launcher: a job ended without a result ({why}); if memory ran out, run fewer jobs at a time"


@contextmanager
def slot_of_job() -> Iterator[None]:
    """Give a job of a multirun the lowest number that no other running job has, so that they use different GPUs.

    A slot that the user has given to the whole call stays.
    """
    hydra = HydraConfig.get()
    if hydra.mode != RunMode.MULTIRUN or SLOT_VARIABLE in os.environ:
        yield
        return
    with hold_slot(Path(hydra.sweep.dir)) as slot, use_slot(slot):
        yield
