"""Connected pieces of a canonical shape, and which of them belong to the subject."""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

__all__ = ["floating_cells"]

_NEEDED = 0.2  # share of the inside points in a piece that are in no larger piece too


def floating_cells(
    occupied: Tensor, finer: list[int], places: Tensor, query: Tensor, components: int | None = None
) -> tuple[Tensor, int]:
    """Return which cells hold nothing but pieces of a shape that do not belong to the subject.

    The largest piece belongs to it, and so does every piece that is needed: a fifth of the points inside the meshes that come
    from there, or more, come from no larger piece. A piece that is hidden in the body in all training poses is not needed.

    Args:
        occupied: [z, y, x], bool, samples of the shape on a lattice that has the nodes of the cells and samples between them.
        finer: into how many parts the samples divide a cell's sides, along z, y and x.
        places: [K, 3], occupied correspondences of points inside the training meshes, along x, y and z in steps of the lattice.
        query: [K], which of these points each belongs to.
        components: number of largest pieces that belong to the subject instead; None to decide by need.

    Returns:
        [D-1, H-1, W-1], bool; and the number of pieces that do not belong to the subject.
    """
    from scipy import ndimage  # here: a trained field is used without it

    found = ndimage.label(occupied.cpu().numpy(), np.ones((3, 3, 3)))
    labels, count = cast("tuple[NDArray[np.int32], int]", found)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    order = np.argsort(-sizes, kind="stable")[:count]
    if components is not None:
        kept = order[:components]
    else:
        kept = order[_needed(labels, order, places.cpu().numpy(), query.cpu().numpy())]
    mine = np.isin(labels, kept)
    window = [factor + 1 for factor in finer]

    def touched(samples: NDArray[np.bool_]) -> Tensor:
        values = torch.as_tensor(samples, device=occupied.device)[None, None].float()
        return F.max_pool3d(values, window, finer)[0, 0] > 0

    return touched((labels > 0) & ~mine) & ~touched(mine), count - len(kept)


def _needed(
    labels: NDArray[np.int32], order: NDArray[np.int64], places: NDArray[np.float32], query: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return which of the pieces, in the order of their sizes, are needed, [P]; for the arguments see `floating_cells`."""
    rank = np.zeros(len(order) + 1, np.int64)  # of each label; labels are 1, 2, ...
    rank[order] = np.arange(len(order))
    rank[0] = len(order)  # no piece
    low = np.floor(places[:, ::-1]).astype(np.int64)
    last = np.array(labels.shape) - 1
    around = [labels[tuple(np.clip(low + corner, 0, last).T)] for corner in np.ndindex(2, 2, 2)]
    piece = rank[np.stack(around)].min(0)  # the largest piece at each place
    largest = np.full(query.max(initial=-1) + 1, len(order))
    np.minimum.at(largest, query, piece)  # the largest piece that each point comes from
    points = np.bincount(piece, minlength=len(order) + 1)[:-1]
    alone = np.bincount(piece[largest[query] == piece], minlength=len(order) + 1)[:-1]
    needed = alone > _NEEDED * points
    needed[:1] = True
    return needed
