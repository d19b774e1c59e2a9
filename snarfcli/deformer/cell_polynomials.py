"""Grid cells as polynomials: their posed images, bounds on these, and their eight parts.

Inside a cell the blended transform T is trilinear (Fast-SNARF Sec. 4.1), and d(x) = T(x) [x; 1] (SNARF Eq. 4). So each
component of d is a polynomial of the cell's coordinates s = (s0, s1, s2), which run from -1/2 to 1/2 along x, y, z, of degree
at most two in each. An eighth of a cell has a polynomial of the same kind. Since a monomial of degree n is at most (1/2)^n in
the cell, sums of absolute coefficients bound everything. The native version is csrc/include/snarf/cell.h.

Coefficients are tensors [3, 3, 3, 3, C]: powers of s2, s1 and s0, component of d, cell. The last dimension is always that of
the cells, or of pairs of a query and a cell, which makes PyTorch fast with small matrices.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = [
    "FACE_TOLERANCE",
    "RootBounds",
    "bound_boxes",
    "bound_roots",
    "cell_polynomials",
    "cut_cells",
    "evaluate",
    "inverse_of",
    "pick",
]

FACE_TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-9}
"""Share of a cell by which a root may lie outside it: rounding may put a root on a face outside both neighbours."""
_EPSILON = {torch.float32: 1e-6, torch.float64: 1e-14}  # several times the rounding error of a sum


@dataclass
class RootBounds:
    """Where in a cell the root of a query can be, and whether there can be several."""

    inverse: Tensor
    """[3, 3, C], inverse of dd/ds at the cell's centre, posed metres to cell coordinates; 0 where dd/ds is singular."""
    reach: Tensor
    """[3, C], largest |inverse (x' - d(0))| of a query x' with a root in the cell."""
    curvature: Tensor
    """[C], how far inverse dd/ds is from the identity anywhere in the cell, at most (row sum of absolute values). Below 1, d is
    injective: a query has at most one root."""


def cell_polynomials(corner_transforms: Tensor, centres: Tensor, cell_size: Tensor) -> Tensor:
    """Return the polynomials [3, 3, 3, 3, C] of cells.

    Args:
        corner_transforms: [C, 8, 12], blended transforms at the corners.
        centres: [3, C], canonical centres, metres.
        cell_size: [3], metres.
    """
    # From values at the corners to coefficients, one axis after the other.
    coefficients = corner_transforms.permute(1, 2, 0).reshape(2, 2, 2, 3, 4, -1)
    for axis in range(3):
        low, high = coefficients.unbind(axis)
        coefficients = torch.stack([(low + high) / 2, high - low], axis)
    linear, shift = coefficients[..., :3, :], coefficients[..., 3, :]
    # d = linear (centre + size s) + shift
    polynomials = shift.new_zeros(3, 3, 3, *shift.shape[3:])
    polynomials[:2, :2, :2] = (linear * centres).sum(4) + shift
    polynomials[:2, :2, 1:] += linear[..., 0, :] * cell_size[0]
    polynomials[:2, 1:, :2] += linear[..., 1, :] * cell_size[1]
    polynomials[1:, :2, :2] += linear[..., 2, :] * cell_size[2]
    return polynomials


def bound_boxes(polynomials: Tensor, level: int = 0) -> Tensor:
    """Return half the sides [3, C] of boxes around the posed centres that contain the images of cells, metres.

    Args:
        polynomials: [3, 3, 3, 3, C].
        level: how often the grid's cells were cut.
    """
    share, _ = _largest(polynomials, level)
    share[0, 0, 0] = 0
    epsilon = _EPSILON[polynomials.dtype]
    return (polynomials.abs() * share).sum((0, 1, 2)) * (1 + 16 * epsilon) + polynomials[0, 0, 0].abs() * epsilon


def bound_roots(polynomials: Tensor, level: int = 0) -> RootBounds:
    """Return bounds on the roots in cells; see `bound_boxes` for the arguments."""
    share, slope = _largest(polynomials, level)
    epsilon = _EPSILON[polynomials.dtype]
    along = polynomials[0, 0, 1], polynomials[0, 1, 0], polynomials[1, 0, 0]
    inverse, determinant = inverse_of(*along)
    longest = [axis.abs().amax(0) for axis in along]
    regular = determinant.abs() > epsilon * longest[0] * longest[1] * longest[2]
    inverse = torch.where(regular, inverse, 0)
    # inverse d(s) = inverse d(0) + s + curved(s)
    curved = (inverse[:, 0] * polynomials[..., 0, None, :]).add_(inverse[:, 1] * polynomials[..., 1, None, :])
    curved = curved.add_(inverse[:, 2] * polynomials[..., 2, None, :]).abs_()
    rounding = (inverse * polynomials[0, 0, 0]).abs().sum(1)
    curved[0, 0, 0] = curved[0, 0, 1] = curved[0, 1, 0] = curved[1, 0, 0] = 0
    reach = 0.5 + FACE_TOLERANCE[polynomials.dtype] * 2**level + (curved * share).sum((0, 1, 2))
    reach = reach + (rounding + reach) * epsilon
    curvature = (curved * slope).sum((0, 1, 2)).amax(0)
    return RootBounds(inverse, torch.where(regular, reach, torch.inf), torch.where(regular, curvature, torch.inf))


def _largest(polynomials: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """Return the largest value and the sum of the largest slopes of each monomial in a cell, [3, 3, 3, 1, 1] both."""
    power = torch.arange(3, dtype=polynomials.dtype, device=polynomials.device)
    degree = (power[:, None, None] + power[:, None] + power)[..., None, None]
    wide = 0.5 + FACE_TOLERANCE[polynomials.dtype] * 2**level
    return wide**degree, degree * 0.5 ** (degree - 1)


def cut_cells(polynomials: Tensor) -> Tensor:
    """Return the polynomials [3, 3, 3, 3, 8, C] of the eight parts of cells, each by its own coordinates from -1/2 to 1/2.

    The centre of part k lies at -1/4 or 1/4 along x, y, z, by the bits of k from the lowest.
    """
    parts = polynomials
    for axis in (2, 1, 0):
        a, b, c = parts.unbind(axis)
        # a + b s + c s^2 with s = h + s' / 2
        halves = [torch.stack([a + h * (b + h * c), b / 2 + h * c, c / 4], axis) for h in (-0.25, 0.25)]
        parts = torch.stack(halves, 4)
    return parts.flatten(4, 6)


def evaluate(polynomials: Tensor, local: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Evaluate polynomials [3, 3, 3, 3, P] at cell coordinates [3, P].

    Returns:
        Values and derivatives by s0, s1 and s2, [3, P] each.
    """

    def value(powers: Tensor, at: Tensor) -> Tensor:
        return torch.addcmul(powers[0], torch.addcmul(powers[1], powers[2], at), at)

    def slope(powers: Tensor, at: Tensor) -> Tensor:
        return torch.addcmul(powers[1], powers[2], at, value=2)

    x, y, z = local
    at_z, by_z = value(polynomials, z), slope(polynomials, z)
    at_zy, by_y, by_z = value(at_z, y), slope(at_z, y), value(by_z, y)
    return value(at_zy, x), slope(at_zy, x), value(by_y, x), value(by_z, x)


def inverse_of(by_x: Tensor, by_y: Tensor, by_z: Tensor) -> tuple[Tensor, Tensor]:
    """Return the inverses [3, 3, P] of 3x3 matrices with these columns, [3, P] each, and their determinants [P].

    A singular matrix gives infinities or NaN.
    """
    rows = [torch.linalg.cross(a, b, dim=0) for a, b in ((by_y, by_z), (by_z, by_x), (by_x, by_y))]
    determinant = (rows[0] * by_x).sum(0)
    return torch.stack(rows) / determinant, determinant


def pick(values: Tensor, index: Tensor) -> Tensor:
    """Return `values[..., index]`, which PyTorch does ten times as fast for a matrix as for more dimensions."""
    if values.ndim == 1:
        return values.index_select(0, index)
    return values.flatten(0, -2).index_select(1, index).unflatten(0, values.shape[:-1])
