"""Which figures an experiment has, and what happens if one cannot be drawn."""

from __future__ import annotations

from fake_runs import fake_plan

from snarfcli.errors import UserError
from snarfcli.reproduce import figures
from snarfcli.reproduce.experiments import EXPERIMENTS
from snarfcli.reproduce.figures import draw_figures


def test_every_experiment_has_curves_over_training_and_pictures_of_frames():
    assert set(figures._FIGURES) == set(EXPERIMENTS)
    for name, own in figures._FIGURES.items():
        assert {"training", "shapes" if name == "stick2d" else "frames"} <= set(own), name


def test_a_figure_that_cannot_be_drawn_is_left_out_with_a_warning(tmp_path, monkeypatch, caplog):
    def broken(*given):
        raise UserError("the samples are gone")

    monkeypatch.setattr(figures, "draw_training", broken)
    monkeypatch.setattr(figures, "draw_sequences", lambda *given: None)
    monkeypatch.setattr(figures, "draw_frames", lambda plan, results, folder, resolution: (folder / "frames.png", "frames"))
    plan = fake_plan(tmp_path, "minutes", systems=("ours-2",))
    assert draw_figures(plan, [], tmp_path, 16) == [(tmp_path / "frames.png", "frames")]
    assert "cannot draw the figure training: the samples are gone" in caplog.text
