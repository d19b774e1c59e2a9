"""Run a program on the pretend GPU: python start.py LIBRARY PROGRAM [ARGUMENT ...]."""

from __future__ import annotations

import atexit
import ctypes
import os
import sys
import traceback
from pathlib import Path


def run(library: str, program: str) -> None:
    """Put the device in place and run a program; not as the main module, which its worker processes run again."""
    ctypes.CDLL(library, mode=ctypes.RTLD_GLOBAL)  # before PyTorch, which is loaded with it
    import pretend_gpu.device

    assert pretend_gpu.device.CUDA.type == "cuda"
    exec(compile(Path(program).read_text(), program, "exec"), {"__name__": "program", "__file__": program})


def main() -> int:
    """Return the exit code: 0, or 1 if the program failed."""
    library, program = sys.argv[1:3]
    del sys.argv[:2], sys.path[0]  # this folder
    try:
        run(library, program)
        return 0
    except BaseException:
        traceback.print_exc()
        return 1


if __name__ == "__main__":
    code = main()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # PyTorch's thread for the device may still hold tensors: the interpreter must not end before it
