"""The figures of the 2D stick show the given shapes and numbers."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from snarfcli.datasets.stick2d import stick_subject
from snarfcli.reproduce import stick2d_figures
from snarfcli.reproduce.stick2d_figures import draw_curves, draw_shapes, extreme_poses
from snarfcli.samples.preprocessing import preprocess_subject
from snarfcli.samples.store import SampleStore
from snarfcli.sampling import SamplingSettings, in_turned_over, winding_numbers


class TrueStick:
    """A field with the exact occupancy of a sequence, or one that is empty."""

    def __init__(self, sequence, is_empty: bool = False) -> None:
        self.sequence, self.is_empty = sequence, is_empty

    def query(self, points: torch.Tensor, bone_transforms: torch.Tensor, pose: torch.Tensor) -> SimpleNamespace:
        frame = int(np.abs(self.sequence.poses - pose.numpy()).sum((1, 2)).argmin())
        mesh = (self.sequence.vertices(frame), self.sequence.faces(frame), points[0].numpy())
        inside = (winding_numbers(*mesh) > 0.5) | in_turned_over(*mesh)
        logits = torch.full(points.shape[:2], -30.0) if self.is_empty else torch.tensor(60.0 * inside[None] - 30)
        return SimpleNamespace(logits=logits)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SampleStore:
    root: Path = tmp_path_factory.mktemp("stick")
    sampling = SamplingSettings(points_per_frame=800, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0)
    preprocess_subject(stick_subject("stick_object"), root, sampling, {"train": 100, "test": 100, "ood": 8})
    return SampleStore.open(root, "stick2d", "stick_object")


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list:
    """The figures at the time of saving."""
    saved = []
    save = stick2d_figures._save
    monkeypatch.setattr(stick2d_figures, "_save", lambda figure, path: (saved.append(figure), save(figure, path)))
    return saved


def test_poses_are_those_that_overlap(store: SampleStore) -> None:
    rows = extreme_poses(store, "object", {}, count=2)
    sequence = store.sequences("ood")[0]
    shares = []
    for frame in range(sequence.num_frames):
        points = sequence.points(frame)[: sequence.num_uniform]
        winding = winding_numbers(sequence.vertices(frame), sequence.faces(frame), points)
        shares.append((winding > 1.5).mean())
    assert [row.frame for row in rows] == [int(np.argmax(shares[:4])), 4 + int(np.argmax(shares[4:]))]


def test_shapes_are_drawn_beside_the_truth(store: SampleStore, tmp_path: Path, figures: list) -> None:
    sequence = store.sequences("ood")[0]
    fields = {"right": TrueStick(sequence), "empty": TrueStick(sequence, is_empty=True), "failed": None}
    rows = extreme_poses(store, "two bones", fields, count=2)
    path = tmp_path / "shapes.png"
    draw_shapes(path, rows, resolution=80)
    assert [file.name for file in tmp_path.iterdir()] == ["shapes.png"]
    picture = np.asarray(Image.open(path).convert("RGB"))
    assert picture.shape[1] > 1.5 * picture.shape[0] > 600  # four panels wide, two high
    axes = np.array(figures[0].axes).reshape(2, 4)
    assert [axis.get_title() for axis in axes[0]] == ["ground truth", "right", "empty", "failed"]
    labels = [float(axis.get_xlabel().split()[1]) for axis in axes[:, 1]]
    assert min(labels) > 99.5
    assert [axis.get_xlabel() for axis in axes[:, 2]] == ["IoU 0.0 %"] * 2
    assert [text.get_text() for text in axes[0, 3].texts] == ["no result"]
    angles = [np.rad2deg(sequence.poses[row.frame, 1:3, 2]).round() for row in rows]
    assert [axis.get_ylabel() for axis in axes[:, 0]] == [f"two bones\n{a:.0f}°, {b:.0f}°" for a, b in angles]
    fill = np.array([int(stick2d_figures._FILL[k : k + 2], 16) for k in (1, 3, 5)])
    filled = (np.abs(picture.astype(int) - fill).max(-1) < 3).any(0)
    quarter = picture.shape[1] // 4
    assert filled[quarter : 2 * quarter].any()
    assert not filled[:quarter].any()
    assert not filled[2 * quarter + 40 :].any()


def test_curves_show_the_values(tmp_path: Path, figures: list) -> None:
    extrapolation = {"forward": {"two bones": 0.98, "object": 0.97}, "backward": {"two bones": 0.5, "object": None}}
    interpolation = {"forward": [(20, 0.96), (10, 0.99)], "backward": [(10, 0.95), (20, None)]}
    draw_curves(tmp_path / "curves.svg", extrapolation, interpolation)
    assert (tmp_path / "curves.svg").stat().st_size > 5000
    bars, curves = figures[0].axes
    heights = sorted(patch.get_height() for patch in bars.patches)
    np.testing.assert_allclose(heights, [0, 50, 97, 98])
    assert sorted(text.get_text() for text in bars.texts) == ["50.0", "97.0", "98.0", "no result"]
    assert [text.get_text() for text in bars.get_xticklabels()] == ["two bones", "object"]
    forward, backward = curves.lines
    np.testing.assert_allclose(forward.get_xydata(), [[10, 99], [20, 96]])
    np.testing.assert_allclose(backward.get_xydata(), [[10, 95], [20, np.nan]])
    assert "degrees" in curves.get_xlabel()
    assert bars.get_ylabel() == curves.get_ylabel() == "IoU, %"
    assert [text.get_text() for text in figures[0].legends[0].get_texts()] == ["forward", "backward"]


def test_nothing_to_draw_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one pose"):
        draw_shapes(tmp_path / "a.png", [])
    with pytest.raises(ValueError, match="at least one value"):
        draw_curves(tmp_path / "a.png", {}, {})
    assert not list(tmp_path.iterdir())
