"""Convert a finished `.glb` file to FBX or USD with Blender, in another process."""

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
    """Return the start of a command that runs a script in Blender: the `bpy` package, or `blender` on the PATH.

    Raises:
        UserError: neither is installed.
    """
    if importlib.util.find_spec("bpy") is not None:
        return [sys.executable]
    blender = shutil.which("blender")
    if blender is None:
        raise UserError(
            "format: wanted Blender for fbx and usd, got no Blender; pip install 'snarf[blender]', or put blender on the PATH, "
            "or give format=glb"
        )
    return [blender, "--background", "--factory-startup", "--python-exit-code", "1", "--python"]


def convert(blender: list[str], glb: Path, path: Path, frame_rate: float) -> int:
    """Write `path`, in the format of its suffix, from a `.glb` file, whole or not at all.

    Args:
        blender: command, see `find_blender`.
        glb: file to read.
        path: file to write, .fbx or .usd in upper or lower case.
        frame_rate: frames per second of the clips; Blender sets keys at whole frames.

    Returns:
        Size of the file in bytes.

    Raises:
        UserError: Blender failed; the message has the last line of its output.
    """
    kind = path.suffix[1:].lower()
    with TemporaryDirectory() as folder:
        result = Path(folder) / f"character.{kind}"  # Blender chooses the format by the suffix, which must be lower case
        command = [*blender, str(_JOB), "--", str(glb), str(result), repr(float(frame_rate)), kind]
        try:
            done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise UserError(f"Blender did not finish {path.name} in {_TIMEOUT_S // 60} minutes; give format=glb") from None
        # Some versions of the package crash at exit, with the file complete: the message counts, not the exit code.
        if "snarf: written" not in done.stdout or not result.is_file() or not result.stat().st_size:
            words = [line for line in (done.stdout + "\n" + done.stderr).splitlines() if line.strip()]
            reason = words[-1].strip()[:200] if words else f"exit code {done.returncode}"
            raise UserError(f"Blender could not write {path.name} ({reason}); give format=glb, or try another Blender")
        with atomic_path(path) as temporary:
            shutil.copyfile(result, temporary)
        return result.stat().st_size
