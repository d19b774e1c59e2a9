"""The body that is fitted, with all that the fit of its poses needs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import Body, Skeleton, builtin_body, find_body, load_body
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.pose_library import PoseLibrary
from snarfcli.registration.starts import PoseFinder

__all__ = ["BodyChoice", "Fitter", "load_fitter"]

Array = NDArray[np.float64]

_VERTICES = 1200  # of the body that are matched with the scan
_BETAS = 10  # shape parameters that are fitted; the others of SMPL-X change little


@dataclass(frozen=True)
class BodyChoice:
    """Which body is fitted; can be sent to other processes."""

    body: str | None = None
    """Body model file, or a folder with it; None for the built-in body."""
    gender: str = "neutral"
    """Of the body model in a folder."""


class Fitter:
    """A body, its surface, and the finder of its poses."""

    def __init__(self, body: Body, source: str) -> None:
        """Prepare a body.

        Args:
            body: in SMPL's format.
            source: where it is from, for messages.
        """
        self.body, self.source = body, source
        has_shapes = body.num_betas > 0 and bool(body.shapedirs.abs().max() > 0)
        self.surface = BodySurface.from_body(body, _VERTICES, betas=min(_BETAS, body.num_betas) if has_shapes else 0)
        self._library = PoseLibrary.builtin(self.surface.joint_names)
        self.prior = self._library.prior()

    @cached_property
    def finder(self) -> PoseFinder:
        """Of poses in single frames."""
        return PoseFinder(self.surface, self._library, self.prior)

    @property
    def length_m(self) -> float:
        """Longest side of the body in its rest pose, metres."""
        return float(np.ptp(self.surface.points_rest, axis=0).max())

    def skeleton(self, betas: Array) -> Skeleton:
        """Return the skeleton of a shape [S], with the legs apart in its canonical pose."""
        return self.body.skeleton(self._betas(betas))

    def mesh(self, state: BodyState) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return the whole body in a state: vertices [V, 3], metres, and faces [F, 3]."""
        pose = torch.from_numpy(state.pose[None]).float()
        posed = self.body.pose(pose, self._betas(state.betas), torch.from_numpy(state.translation[None]).float())
        return posed.vertices[0].numpy(), self.body.faces.numpy()

    def _betas(self, betas: Array) -> Array:
        return np.concatenate([betas, np.zeros(self.body.num_betas - len(betas))])


def load_fitter(choice: BodyChoice) -> Fitter:
    """Read the body.

    Raises:
        UserError: there is no such body, or its file is damaged.
    """
    if choice.body is None:
        return Fitter(builtin_body(), "the built-in body (CC0)")
    path = find_body(Path(choice.body), None, choice.gender)
    return Fitter(load_body(path), f"body {path}")
