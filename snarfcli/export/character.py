"""A character: one canonical mesh, a rig, clips and morph targets, as glTF stores them, and its errors."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from snarfcli.checks import check_number
from snarfcli.errors import UserError
from snarfcli.export.deviation import Deviation
from snarfcli.export.morphs import ShapeBasis
from snarfcli.export.rig import LocalTransforms
from snarfcli.field_docs import documented
from snarfcli.meshing.mesh import Mesh
from snarfcli.meshing.posed import RESOLUTIONS

__all__ = ["Character", "CharacterClip", "CharacterErrors", "CharacterOptions", "check_options"]

INFLUENCES = (4, 8)
TRIANGLES = (100, 5_000_000)
MORPH_TARGETS = (0, 64)


@documented
@dataclass(frozen=True)
class CharacterOptions:
    """Limits on the size of a character."""

    triangles: int | None = 20000
    """Maximum number of triangles; None keeps the extracted surface."""
    influences: int = 4
    """Maximum number of joints per vertex: 4, or 8, which fewer programs can read."""
    morph_targets: int = 8
    """Maximum number of morph targets for the pose-dependent shape; with 0 all frames have the mean shape."""
    resolution: int = 256
    """Cells along the longest side of the canonical box, from which the surface is extracted."""
    weight_colors: bool = False
    """Whether vertices are coloured by their skinning weights."""


@dataclass(frozen=True, eq=False)
class CharacterClip:
    """One clip of a character."""

    name: str
    """Unique in its character."""
    frame_rate: float
    """Frames per second; the first frame is at time 0."""
    joints: LocalTransforms
    """Local transforms of T frames."""
    shape_weights: NDArray[np.float32]
    """[T, K] weights of the morph targets."""


@dataclass(frozen=True, eq=False)
class CharacterErrors:
    """Distances between a character and the skinned surface of its avatar, over all vertices and frames."""

    truncation: Deviation = field(default_factory=Deviation)
    """Error of the reduced number of influences, in the exact shape."""
    shape_error: Deviation = field(default_factory=Deviation)
    """Error of the morph targets, canonical."""
    shape_motion: Deviation = field(default_factory=Deviation)
    """Distance of the pose-dependent shape from its mean, canonical: the error without morph targets."""
    deviation: Deviation = field(default_factory=Deviation)
    """Total error of the posed character: both errors, the rounding of the file, and shear, which nodes cannot express."""


@dataclass(frozen=True, eq=False)
class Character:
    """The content of a character file."""

    mesh: Mesh
    """In the pose that is stored, usually the canonical one, with normals and all weights."""
    joints: NDArray[np.int64]
    """[V, 4 or 8] joints that move a vertex."""
    weights: NDArray[np.float32]
    """[V, 4 or 8] their weights; rows sum to 1."""
    shapes: ShapeBasis
    """K morph targets, whose weights are from 0 to 1; the base is that of `mesh`, in the stored pose."""
    bind: NDArray[np.float64]
    """[J, 4, 4] joint frames in the stored pose."""
    clips: list[CharacterClip]
    """The motions."""
    errors: CharacterErrors
    """Accuracy of the character."""
    skipped: list[tuple[str, int, str]]
    """Clip, frame and reason of frames whose shape could not be followed; it is interpolated from the frames around."""


def check_options(options: CharacterOptions) -> None:
    """Check the options of a character.

    Raises:
        UserError: one is out of range.
    """
    if options.influences not in INFLUENCES:
        raise UserError(f"influences: wanted {' or '.join(map(str, INFLUENCES))}, got {options.influences}")
    check_number("triangles", options.triangles, *TRIANGLES)
    check_number("morph_targets", options.morph_targets, *MORPH_TARGETS)
    check_number("resolution", options.resolution, *RESOLUTIONS)
