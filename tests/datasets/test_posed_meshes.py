"""Sources of posed meshes: what worker processes import, and which files count as changed."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from snarfcli.datasets.cape_frames import CapeMeshes
from snarfcli.datasets.posed_meshes import FileMeshes
from snarfcli.formats.surfaces import read_surface

_MODULES = ["cli.main", "datasets.cape_frames", "datasets.posed_meshes", "samples.sequence", "formats.surfaces"]


@pytest.mark.parametrize("module", [f"snarfcli.{name}" for name in _MODULES])
def test_worker_processes_start_without_pytorch(module: str) -> None:
    """Importing PyTorch takes longer than sampling ten frames, and every task of `snarf preprocess` starts a process."""
    code = f"import sys, {module}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.parametrize("kind", ["meshes", "cape"])
def test_changed_files_are_noticed_and_copies_are_not_changes(tmp_path: Path, kind: str) -> None:
    def fingerprint(folder: Path) -> str:
        paths = sorted(folder.iterdir())
        return (CapeMeshes(paths, np.eye(3)) if kind == "cape" else FileMeshes(paths, read_surface, np.eye(4))).fingerprint()

    (tmp_path / "a").mkdir()
    for name in ("0.npz", "1.npz"):
        np.savez(tmp_path / "a" / name, v_posed=np.zeros((6890, 3)), pose=np.zeros(72), transl=np.zeros(3))
    before = fingerprint(tmp_path / "a")
    shutil.copytree(tmp_path / "a", tmp_path / "b", copy_function=shutil.copyfile)
    assert fingerprint(tmp_path / "b") == before
    size = (tmp_path / "b" / "1.npz").stat().st_size
    vertices = np.zeros((6890, 3))
    vertices[0, 0] = 0.25
    np.savez(tmp_path / "b" / "1.npz", v_posed=vertices, pose=np.zeros(72), transl=np.zeros(3))
    assert (tmp_path / "b" / "1.npz").stat().st_size == size
    assert fingerprint(tmp_path / "b") != before
    (tmp_path / "a" / "1.npz").rename(tmp_path / "a" / "2.npz")
    assert fingerprint(tmp_path / "a") != before
