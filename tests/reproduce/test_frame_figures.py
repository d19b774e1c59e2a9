"""The worst and a typical frame of each system beside the ground truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fake_runs import fake_plan, fake_run, read
from PIL import Image
from toy_training import toy_store

from snarfcli.errors import UserError
from snarfcli.files import write_json
from snarfcli.reproduce import frame_figures
from snarfcli.reproduce.frame_figures import MeasuredFrame, draw_frames, worst_and_typical
from snarfcli.reproduce.results import collect


def test_the_typical_frame_is_the_median():
    frames = [MeasuredFrame("kicks", number, iou) for number, iou in enumerate((0.9, 0.2, 0.7, 0.6))]
    chosen = worst_and_typical(frames)
    assert chosen is not None
    assert [frame.number for frame in chosen] == [1, 3]
    assert worst_and_typical(frames[:1]) == (frames[0], frames[0])
    assert worst_and_typical([]) is None


@pytest.fixture
def plan(tmp_path, monkeypatch):
    """Two evaluated systems on a bending capsule, whose predicted surface is the ground truth."""
    store = toy_store(tmp_path / "toy", points=40, frames=8)
    plan = fake_plan(tmp_path, systems=("nasa", "ours-local"))
    sequence = store.sequences("ood")[0]
    monkeypatch.setattr(frame_figures, "open_samples", lambda result, split: store)
    monkeypatch.setattr(frame_figures, "load_avatar", lambda result: None if result.job.row == "nasa" else "avatar")
    monkeypatch.setattr(frame_figures, "predicted_surface", lambda avatar, one, index, resolution: mesh_of(one, index))
    numbers = [int(sequence.frame_numbers[index]) for index in (1, 0, -1)]
    for job in plan.jobs:
        fake_run(job, {"id": 0.9, "ood": 0.8})
        path = Path(job.evaluations[1].metrics)
        frames = {"frame": numbers, "iou_surface": [0.9, 0.123, 0.456]}
        damaged = {"frame": [1, "x"], "iou_surface": [None, 0.1]}
        sequences = {sequence.name: {"per_frame": frames}, "damaged": {"per_frame": damaged}, "old": {"iou_surface": 0.5}}
        write_json(path, read(path) | {"sequences": sequences})
    return plan


def mesh_of(sequence, index):
    return frame_figures.Mesh(sequence.vertices(index), sequence.faces(index))


def test_each_system_has_a_row_with_its_frames(plan, tmp_path, monkeypatch):
    sheets = []
    original = frame_figures.contact_sheet
    monkeypatch.setattr(
        frame_figures, "contact_sheet", lambda rows, **more: (sheets.append((rows, more)), original(rows, **more))[1]
    )
    drawn = draw_frames(plan, [collect(job) for job in plan.jobs], tmp_path / "figures", 16)
    assert drawn is not None
    path, caption = drawn
    assert np.asarray(Image.open(path)).shape[1] > 4 * frame_figures._PANEL
    assert "subject 50002, seed 0" in caption
    ((rows, about),) = sheets
    assert about["row_labels"] == ["NASA", "ours, condition=local"]
    assert [[picture is None for picture in row] for row in rows] == [[False, True, False, True], [False] * 4]
    np.testing.assert_array_equal(rows[1][0], rows[1][1], "the same surface, camera and floor")
    assert (rows[1][0] != rows[1][2]).any(), "another frame"
    assert [caption.split(" %")[0] for caption in about["captions"][0][1::2]] == ["surface IoU 12.3", "surface IoU 45.6"]


def test_frames_that_are_not_there_are_an_error(plan, tmp_path):
    for job in plan.jobs:
        path = Path(job.evaluations[1].metrics)
        write_json(path, read(path) | {"sequences": {"kicks": {"per_frame": {"frame": [7], "iou_surface": [0.5]}}}})
    with pytest.raises(UserError, match="the samples have no frame 7 of kicks any more; evaluate again"):
        draw_frames(plan, [collect(job) for job in plan.jobs], tmp_path / "figures", 16)
    for job in plan.jobs:
        Path(job.evaluations[1].metrics).unlink()
    assert draw_frames(plan, [collect(job) for job in plan.jobs], tmp_path / "figures", 16) is None
