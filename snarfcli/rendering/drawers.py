"""Processes that draw what another one extracts: a GPU makes surfaces faster than one core draws them."""

from __future__ import annotations

import contextlib
import multiprocessing
import pickle
import signal
import time
from collections.abc import Mapping
from multiprocessing.connection import Connection

import numpy as np

from snarfcli.errors import UserError
from snarfcli.meshing.mesh import Mesh
from snarfcli.rendering.panels import Screen

__all__ = ["Drawer"]


class Drawer:
    """A process that draws one frame at a time. It pays no heed to Ctrl-C: whoever started it ends it."""

    def __init__(self, screen: Screen) -> None:
        """Start it; hold interrupts back meanwhile."""
        context = multiprocessing.get_context("spawn")
        self._line, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, pickle.dumps(screen)), daemon=True)
        self._process.start()
        theirs.close()

    def begin(self, frame: int, shown: Mapping[str, Mesh | None]) -> None:
        """Hand over what is to be seen in a frame, see `Screen.draw`; the last picture must have been taken."""
        try:
            self._line.send((frame, shown))
        except OSError:
            raise self._lost() from None

    def take(self) -> tuple[np.ndarray, float]:
        """Wait for the picture, and return it and the seconds that it took.

        Raises:
            UserError: the process ended without a word, as when the system kills it for want of memory.
            Exception: whatever went wrong with the drawing.
        """
        try:
            picture = self._line.recv()
        except (EOFError, OSError):
            raise self._lost() from None
        if isinstance(picture, Exception):
            raise picture
        return picture

    def end(self) -> None:
        """End the process; nothing is left of it afterwards."""
        self._line.close()  # whoever waits for a frame, or to hand one over, goes on then, to its end
        self._process.terminate()
        self._process.join()

    def _lost(self) -> UserError:
        self._process.join()
        return UserError(
            f"a process that draws ended early (exit code {self._process.exitcode}); if memory ran out, try again with fewer, "
            "for example processes=2"
        )


def _serve(line: Connection, setup: bytes) -> None:
    """Draw until nobody is there any more."""
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    screen: Screen = pickle.loads(setup)
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            frame, shown = line.recv()
            start = time.perf_counter()
            try:
                answer = (screen.draw(frame, shown), time.perf_counter() - start)
            except Exception as error:  # the one who asked decides what it means
                answer = RuntimeError(f"{type(error).__name__}: {error}")
            line.send(answer)
