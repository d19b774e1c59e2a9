"""Run snarfcli.native.cuda_launches on the CPU: the kernels of csrc/cuda, compiled as C++ (emulation/cuda_shim.h)."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
from collections import defaultdict
from functools import cache
from pathlib import Path

import numpy as np
import torch

from snarfcli.native.cuda_compile import cuda_sources

__all__ = ["EmulatedGpu", "build_emulation", "host_compiler", "require_compiler"]

_FOLDER = Path(__file__).parent / "emulation"
_NUMBERS = {torch.float32: "float", torch.float64: "double"}
_PROGRAMS = {"network": "network"}  # files of emulation/ with the kernels of a source; emulation.cpp has those of the others


class EmulatedGpu:
    """A launcher whose blocks have up to `block` threads; 1 is fastest. Blocks of the network have as many as on a GPU.

    With `seed` the blocks of each launch run in an order of that seed, by which `work` is then ordered as well.

    `work` has what the blocks of each launch did, by kernel: int64 [blocks, 2, 3] with the sum over a block's threads and the
    most of one thread, of rounds (in which the block's threads take a candidate each), halvings of a cell and Newton solves.
    """

    capability = (9, 0)
    most_shared_bytes = 227 * 1024
    multiprocessors = 1

    def __init__(self, dtype: torch.dtype, block: int = 1, seed: int = 0) -> None:
        self.dtype = dtype
        self.block = block
        self.seed = seed
        self.launches: list[str] = []
        self.work: dict[str, list[np.ndarray]] = defaultdict(list)

    def threads(self, most: int) -> int:
        return min(most, self.block)

    def launch(
        self,
        source: str,
        kernel: str,
        blocks: tuple[int, int],
        threads: int,
        arguments: ctypes.Structure,
        shared_bytes: int = 0,
    ) -> None:
        self.launches.append(kernel)
        assert shared_bytes <= self.most_shared_bytes
        assert (cuda_sources() / "cuda" / f"{source}.cu").read_text().count(f" {kernel}(") == 1
        assert min(blocks) > 0
        library = build_emulation(self.dtype, _PROGRAMS.get(source, "emulation"))
        library.shuffle_blocks(self.seed)
        assert library.emulate(kernel.encode(), ctypes.byref(arguments), *blocks, threads)
        counted = np.ctypeslib.as_array(library.work_of_blocks(), (blocks[0] * blocks[1], 2, 3))
        self.work[kernel].append(counted.copy())


def host_compiler() -> str | None:
    """Return a C++ compiler with GCC's command line, or None."""
    chosen = os.environ.get("CXX")
    return next((path for name in (chosen, "g++", "clang++", "c++") if name and (path := shutil.which(name))), None)


def require_compiler() -> None:
    """Skip the running test where there is no C++ compiler, without which the kernels cannot be emulated."""
    if host_compiler() is None:
        import pytest  # here, since benchmarks use the emulation too

        pytest.skip("needs a C++ compiler")


def build_emulation(dtype: torch.dtype, program: str = "emulation") -> ctypes.CDLL:
    """Compile the kernels of a program for one type of numbers and load them, once.

    Args:
        dtype: type of all numbers.
        program: file of emulation/, without its ending.

    SNARF_EMULATION_FLAGS adds flags to the compiler. With LD_PRELOAD=$(g++ -print-file-name=libtsan.so)
    SNARF_EMULATION_FLAGS=-fsanitize=thread the threads of a block run at the same time, and races are reported.
    """
    return _build(dtype, program)


@cache
def _build(dtype: torch.dtype, program: str) -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "kernels.so"
        command = [host_compiler(), "-std=c++17", "-O2", "-g", "-shared", "-fPIC", "-pthread"]
        command += ["-Wall", "-Wextra", "-Werror", "-Wno-psabi", f"-DSNARF_NUMBER={_NUMBERS[dtype]}"]
        command += [f"-I{cuda_sources() / 'include'}", f"-I{cuda_sources() / 'cuda'}"]
        command += os.environ.get("SNARF_EMULATION_FLAGS", "").split()
        command += ["-o", str(library), str(_FOLDER / f"{program}.cpp")]
        built = subprocess.run(command, capture_output=True, text=True)
        if built.returncode:
            raise RuntimeError(f"{' '.join(command)}\n{built.stderr}")
        loaded = ctypes.CDLL(str(library), mode=ctypes.RTLD_LOCAL)
    loaded.emulate.restype = ctypes.c_bool
    structures = ("search", "backward", "encoding", "interpolation", "optimizer", "optimizer_task", "segment", "variation")
    for structure in structures if program == "emulation" else ("packing", "evaluation"):
        getattr(loaded, f"{structure}_bytes").restype = ctypes.c_size_t
    loaded.work_of_blocks.restype = ctypes.POINTER(ctypes.c_longlong)
    return loaded
