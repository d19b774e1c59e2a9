"""The table on the terminal, and metrics.json."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from snarfcli.evaluation.metrics import FrameMetrics
from snarfcli.evaluation.report import EvaluationReport, metrics_content, plain, table, timings_text
from snarfcli.files import write_json

FRAME = FrameMetrics("walk", 0, 0, 0.9625, 0.87, 0.955, 1000, 900, 200, 400, 100, 1, 0.001, 0.004, 0.006)
FRAMES = [
    FRAME,
    replace(FRAME, index=1, frame=4, iou_bbox=0.9525, iou_surface=0.85),
    replace(FRAME, sequence="handstand", iou_bbox=1.0, iou_surface=1.0, without=0, inside_without=0),
]
MACHINE = {"versions": {"snarf": "1.2.3", "torch": "2.9"}, "machine": {"processor": "abacus", "threads": 2}}
EVALUATION = EvaluationReport(
    data="builtin",
    subject="50002",
    model="fast_snarf",
    split="ood",
    frames=FRAMES,
    wall_s=1.5,
    machine=MACHINE,
    training={"steps": 10, "validation": {"iou_bbox": torch.tensor(0.5)}},
    search={"name": "complete"},
    samples={"points_per_frame": 1000},
)
SETTINGS = {"seed": 3, "split": "ood", "ckpt": None, "data": {"name": "builtin"}}


def test_text_of_the_table():
    assert (
        table(EVALUATION)
        == """\
fast_snarf of subject 50002, data builtin, out of distribution (ood)

                                        IoU %                 no correspondence %
sequence           frames    bbox  surface   tight   worst         all     inside
---------------------------------------------------------------------------------
walk                    2   95.75    86.00   95.50   85.00       40.00      1.000
handstand               1  100.00   100.00   95.50  100.00        0.00      0.000
---------------------------------------------------------------------------------
mean of sequences           97.88    93.00   95.50
all frames              3   97.17    90.67   95.50   85.00       26.67      0.667
bbox: the papers' cube; surface: near the surface; tight: the mesh's own box;
worst: lowest surface IoU of a frame"""
    )


def test_table_fits_100_columns_with_any_names():
    long = replace(EVALUATION, frames=[replace(FRAME, sequence="a_very_long_name_of_a_sequence_" * 3)], subject="7" * 20)
    lines = table(long).splitlines()
    assert max(len(line) for line in lines) <= 100
    assert any(line.startswith("a_very_long_name_of_a_seque...") for line in lines)
    assert "mean of sequences" not in table(long)  # of one sequence it says nothing new


def test_numbers_stand_under_their_heads():
    lines = table(EVALUATION).splitlines()
    heads, row = lines[3], lines[5]
    for head, number in [("bbox", "95.75"), ("surface", "86.00"), ("worst", "85.00"), ("all", "40.00"), ("inside", "1.000")]:
        assert heads.index(head) + len(head) == row.index(number) + len(number)


def test_times_are_for_the_points_of_the_papers_table():
    # 3 frames of 1000 points take 3 ms + 12 ms + 3 ms of the rest; 200,000 points take 66.7 times as long
    assert timings_text(EVALUATION) == (
        "time for 200,000 points: search 200.0 ms, shape 800.0 ms, total 1200.0 ms\n3 frames in 1.5 s on cpu, 2 threads"
    )


def test_metrics_file_has_what_a_reader_needs(tmp_path: Path):
    write_json(tmp_path / "metrics.json", metrics_content(EVALUATION, SETTINGS))
    content = json.loads((tmp_path / "metrics.json").read_text())
    assert {name: content[name] for name in ("data", "subject", "model", "split", "frames", "seed")} == {
        "data": "builtin", "subject": "50002", "model": "fast_snarf", "split": "ood", "frames": 3, "seed": 3,
    }  # fmt: skip
    assert content["iou_bbox"] == np.mean([0.9625, 0.9525, 1.0])
    assert content["iou_surface"] == np.mean([0.87, 0.85, 1.0])
    assert set(content["sequences"]) == {"walk", "handstand"}
    walk = content["sequences"]["walk"]
    assert (walk["frames"], walk["iou_surface"]) == (2, 0.86)
    assert walk["per_frame"]["frame"] == [0, 4]
    assert walk["per_frame"]["iou_bbox"] == [0.9625, 0.9525]
    assert content["timings"]["search_ms_per_200k"] == 200.0
    assert content["timings"]["wall_s"] == 1.5
    assert content["versions"]["torch"] == "2.9"
    assert content["machine"]["processor"] == "abacus"
    assert content["training"] == {"steps": 10, "validation": {"iou_bbox": 0.5}}
    assert content["settings"] == SETTINGS
    assert content["search"] == {"name": "complete"}
    assert content["samples"] == {"points_per_frame": 1000}
    assert "mean over all frames" in content["protocol"]["averaging"]


def test_plain_values_survive_json():
    value = {1: torch.ones(2), "nan": float("nan"), "inf": np.float32("inf"), "path": Path("a"), "flag": np.bool_(True)}
    assert plain(value) == {"1": [1.0, 1.0], "nan": None, "inf": None, "path": "a", "flag": True}
    assert plain((5e-6, None, "text", 3)) == [5e-6, None, "text", 3]
