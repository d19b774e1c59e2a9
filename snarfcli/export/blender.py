"""Formats that only Blender writes well, made from a finished `.glb` by a Blender of its own, in another process."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from snarfcli.errors import UserError
from snarfcli.files import atomic_path

__all__ = ["BLENDER_FORMATS", "convert", "find_blender"]

BLENDER_FORMATS = ("fbx", "usd")
_JOB = Path(__file__).with_name("blender_job.py")
_TIMEOUT_S = 1800


def find_blender() -> list[str]:
    """Return the start of a command line that runs a script in Blender: the `bpy` package, or `blender` on the path.

    Raises:
        UserError: neither is there.
    """
    if importlib.util.find_spec("bpy") is not None:
        return [sys.executable]
    blender = shutil.which("blender")
    if blender is None:
        raise UserError(
            "fbx and usd are written by Blender, which is not here; pip install 'snarf[blender]', or put blender on the PATH, "
            "or give format=glb"
        )
    return [blender, "--background", "--factory-startup", "--python-exit-code", "1", "--python"]


def convert(blender: list[str], glb: Path, path: Path, frame_rate: float) -> int:
    """Write `path`, in the format of its suffix, from a `.glb` file, whole or not at all.

    Args:
        blender: see `find_blender`.
        glb: the file to read.
        path: the file to write, .fbx or .usd in either case of letters.
        frame_rate: frames a second of its clips; Blender keys whole frames.

    Returns:
        Its size in bytes.

    Raises:
        UserError: Blender failed; the message ends with its own last words.
    """
    kind = path.suffix[1:].lower()
    with TemporaryDirectory() as folder:
        made = Path(folder) / f"made.{kind}"  # Blender goes by suffixes, and not everywhere by .FBX
        command = [*blender, str(_JOB), "--", str(glb), str(made), repr(float(frame_rate)), kind]
        try:
            done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise UserError(f"Blender did not finish {path.name} in {_TIMEOUT_S // 60} minutes; give format=glb") from None
        # Some versions of the package crash on their way out, with the file complete: its last words count, not its code.
        if "snarf: written" not in done.stdout or not made.is_file() or not made.stat().st_size:
            words = [line for line in (done.stdout + "\n" + done.stderr).splitlines() if line.strip()]
            reason = words[-1].strip()[:200] if words else f"exit code {done.returncode}"
            raise UserError(f"Blender could not write {path.name} ({reason}); give format=glb, or try another Blender")
        with atomic_path(path) as temporary:
            shutil.copyfile(made, temporary)
        return made.stat().st_size
