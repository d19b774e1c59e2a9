"""The notebook: it runs from top to bottom, here with less of everything, and is stored without results."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from run_notebook import cells, run_notebook

import snarfcli.motions
from snarfcli.motions import builtin_motion

ROOT = Path(__file__).parents[2]
NOTEBOOK = ROOT / "examples/first_avatar.ipynb"
FRAMES = "data.frame_step=40 data.test_frame_step=40 data.ood_frame_step=100"
LESS = f"{FRAMES} points_per_frame=2000 'sequences=[chicken_wings,shake_hips,lunges]'"


def test_it_is_stored_without_results():
    notebook = json.loads(NOTEBOOK.read_text("utf-8"))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert len(code) > 5
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    assert set(notebook["metadata"]) == {"kernelspec", "language_info"}  # nothing of the machine it was written on


def test_it_runs_from_top_to_bottom(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setattr(snarfcli.motions, "builtin_motion", lambda *args, **more: builtin_motion(*args, **more).slice(stop=4))
    names = run_notebook(
        NOTEBOOK,
        {
            "training": "smoke training.steps=20",
            "samples": LESS,
            "measures": "figure_frames=1 figure_resolution=48",
            "resolution": 48,
        },
    )
    run = tmp_path / "first_avatar/outputs/builtin/50002/first"
    assert {"avatar.pt", "eval_id", "eval_ood", "character.glb", "character.html"} <= {path.name for path in run.iterdir()}
    assert 0.02 < float((names["occupancy"] > 0.5).float().mean()) < 0.6
    assert len(names["found"].canonical) >= names["points"].shape[1]
    assert float(names["pose"].grad.norm()) > 0


def test_a_failing_command_ends_the_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.ipynb"
    path.write_text(
        json.dumps({"cells": [{"cell_type": "code", "source": ["a = 1"]}, {"cell_type": "code", "source": ["!exit {a}"]}]})
    )
    assert cells(path) == ["a = 1", "!exit {a}"]
    with pytest.raises(Exception, match="exit status 1"):
        run_notebook(path, {})
    with pytest.raises(KeyError, match="no variable b"):
        run_notebook(path, {"b": 2})
