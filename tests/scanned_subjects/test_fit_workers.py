"""Sequences that are fitted by workers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from snarfcli.bodies import builtin_body
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.scanned_subjects import fit_workers


class Scans:
    """Frames of one topology, of which those that serve as anchors have their vertices in another order."""

    def __init__(self) -> None:
        sphere = np.random.default_rng(0).normal(size=(200, 3))
        self.usual = sphere / np.linalg.norm(sphere, axis=1, keepdims=True)

    def __len__(self) -> int:
        return 31

    def __getitem__(self, index: int) -> None:
        return None

    def faces(self) -> np.ndarray:
        return np.stack([np.arange(198), np.arange(1, 199), np.arange(2, 200)], 1)

    def vertices(self, index: int) -> np.ndarray:
        return self.usual[np.random.default_rng(index).permutation(200)] if index % 10 == 0 else self.usual


def test_anchors_of_other_vertices_leave_a_sequence_to_its_points():
    body = builtin_body()
    surface = BodySurface.from_body(body, 100)
    state = BodyState.from_pose(np.zeros((24, 3)), np.zeros(3), np.zeros(10))
    found = SimpleNamespace(state=state, agreement=SimpleNamespace(misfit=0.05))
    finder = SimpleNamespace(find=lambda scan, **options: found)
    fitter: Any = SimpleNamespace(faces=body.faces.numpy(), whole=surface, finder=finder)
    scans: Any = Scans()
    told: list[int] = []
    assert fit_workers._follow_vertices(fitter, np.zeros(10), 0.0, scans, told.append) is None
    assert told == []
