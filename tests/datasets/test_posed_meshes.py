"""Where meshes come from: what worker processes have to import for it."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize("module", ["snarfcli.cli", "snarfcli.datasets.posed_meshes", "snarfcli.datasets.store"])
def test_worker_processes_start_without_pytorch(module: str) -> None:
    """Importing it takes longer than sampling ten frames; every task of `snarf preprocess` starts a process."""
    code = f"import sys, {module}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
