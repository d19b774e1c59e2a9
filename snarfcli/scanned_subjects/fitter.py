"""The body that is fitted, with all that the fit of its poses needs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from snarfcli.bodies import Body, Skeleton, builtin_body, find_body, load_body
from snarfcli.files import file_digest
from snarfcli.registration.body_surface import BodyState, BodySurface
from snarfcli.registration.pose_library import PoseLibrary
from snarfcli.registration.rigs import RigSurface, read_rig
from snarfcli.registration.solver import PosePrior
from snarfcli.registration.starts import PoseFinder

__all__ = ["BodyChoice", "Fitter", "RigFitter", "load_fitter"]

Array = NDArray[np.float64]

_VERTICES = 1200  # of the body that are matched with the scan
_BETAS = 10  # shape parameters that are fitted; the others of SMPL-X change little
_UPRIGHT = 1.3  # a body this much higher than deep is usually highest when it stands


@dataclass(frozen=True)
class BodyChoice:
    """Which body is fitted; can be sent to other processes."""

    body: str | None = None
    """Body model file, or a folder with it; None for the built-in body."""
    gender: str = "neutral"
    """Of the body model in a folder."""
    skeleton: str | None = None
    """A rig in place of a body: a glTF file, or a skeleton file with a mesh."""
    size: float = 1.0
    """Factor by which the rig is made larger, so that it is about as large as what the scans show in metres."""


class Fitter(ABC):
    """A body, its surface, and the finder of its poses."""

    source: str
    """Where it is from, for messages."""
    surface: BodySurface
    """The vertices that are matched with scans."""
    whole: BodySurface
    """All vertices."""
    faces: NDArray[np.int64]
    """[F, 3], of all vertices."""
    library: PoseLibrary
    """Poses from which searches start."""
    digest: str
    """Tells whether a body of files is still the same; empty for the built-in body."""

    @cached_property
    def prior(self) -> PosePrior:
        """Of the poses."""
        return self.library.prior()

    @cached_property
    def finder(self) -> PoseFinder:
        """Of poses in single frames."""
        return PoseFinder(self.surface, self.library, self.prior)

    @property
    def length_m(self) -> float:
        """Longest side of the body in its rest pose, metres."""
        return float(np.ptp(self.surface.points_rest, axis=0).max())

    @property
    def is_upright(self) -> bool:
        """Whether the body is higher than deep, as a person is and most animals are not."""
        sides = np.ptp(self.surface.points_rest, axis=0)
        return bool(sides[1] > _UPRIGHT * sides[2])

    @abstractmethod
    def skeleton(self, betas: Array) -> Skeleton:
        """Return the skeleton of a shape [S]."""

    @abstractmethod
    def mesh(self, state: BodyState) -> tuple[NDArray, NDArray]:
        """Return the whole body in a state: vertices [V, 3], metres, and faces [F, 3]."""


class BodyFitter(Fitter):
    """A body in SMPL's format."""

    def __init__(self, body: Body, source: str, digest: str) -> None:
        """Prepare a body; `source` says where it is from."""
        self.body, self.source, self.digest = body, source, digest
        has_shapes = body.num_betas > 0 and bool(body.shapedirs.abs().max() > 0)
        self.surface = BodySurface.from_body(body, _VERTICES, betas=min(_BETAS, body.num_betas) if has_shapes else 0)
        self.faces = body.faces.numpy()

    @cached_property
    def whole(self) -> BodySurface:
        """All vertices."""
        return BodySurface.from_body(self.body, len(self.body.v_template), betas=self.surface.num_betas)

    @cached_property
    def library(self) -> PoseLibrary:
        """Poses from which searches start."""
        return PoseLibrary.builtin(self.surface.joint_names)

    def skeleton(self, betas: Array) -> Skeleton:
        """Return the skeleton of a shape [S], with the legs apart in its canonical pose."""
        return self.body.skeleton(betas)

    def mesh(self, state: BodyState) -> tuple[NDArray, NDArray]:
        """Return the whole body in a state: vertices [V, 3], metres, and faces [F, 3]."""
        posed = self.body.pose(state.pose[None], state.betas, state.translation[None])
        return posed.vertices[0].numpy(), self.faces


class RigFitter(Fitter):
    """A rigged mesh, such as an animal."""

    def __init__(self, rig: RigSurface) -> None:
        """Prepare a rig, in metres."""
        self.rig, self.source, self.digest = rig, rig.source, rig.digest
        self.surface = rig.surface(_VERTICES)
        self.library, self.faces = rig.library, rig.faces

    @cached_property
    def whole(self) -> BodySurface:
        """All vertices."""
        return self.rig.surface(len(self.rig.vertices))

    def skeleton(self, betas: Array) -> Skeleton:
        """Return the skeleton in the size that the shape parameter says."""
        return self.rig.shaped(betas).skeleton

    def mesh(self, state: BodyState) -> tuple[NDArray, NDArray]:
        """Return the whole mesh in a state: vertices [V, 3], metres, and faces [F, 3]."""
        return self.rig.mesh(state)


def load_fitter(choice: BodyChoice) -> Fitter:
    """Read the body.

    Raises:
        UserError: there is no such body or rig, or its file is damaged.
    """
    if choice.skeleton is not None:
        return RigFitter(read_rig(choice.skeleton).resized(choice.size))
    if choice.body is None:
        return BodyFitter(builtin_body(), "the built-in body (CC0)", "")
    path = find_body(Path(choice.body), None, choice.gender)
    return BodyFitter(load_body(path), f"body {path}", file_digest(path)[:16])
