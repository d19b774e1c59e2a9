"""Where meshes come from: what worker processes have to import for it."""

from __future__ import annotations

import subprocess
import sys

import pytest

_MODULES = ["cli", "datasets.cape_frames", "datasets.posed_meshes", "datasets.store", "formats.surfaces"]


@pytest.mark.parametrize("module", [f"snarfcli.{name}" for name in _MODULES])
def test_worker_processes_start_without_pytorch(module: str) -> None:
    """Importing it takes longer than sampling ten frames; every task of `snarf preprocess` starts a process."""
    code = f"import sys, {module}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
