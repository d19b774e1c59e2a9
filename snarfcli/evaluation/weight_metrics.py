"""Difference between learned skinning weights and those that made the posed meshes.

Both are compared at the vertices of the body's mesh in the canonical pose. The difference of two rows of weights is the total
variation distance, half the sum of the absolute differences: the share of a vertex's weight that is on wrong bones.

Precision, recall and L1 norm are those of automatic rigging (RigNet, Xu et al., SIGGRAPH 2020). A bone influences a vertex
if its weight is above 0.01. Precision is the share of a vertex's learned influences that are true, recall the share of its true
influences that were learned. Both, and the sum of the absolute differences, are averaged over vertices, as in the released code
of Anymate (Deng et al., SIGGRAPH 2025). Publications use different thresholds (0.05 in that code), and precision depends on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies import MeshTemplate
from snarfcli.models.trained_field import TrainedField

__all__ = ["compare_weights", "measure_weights", "weights_text"]

_POINTS_AT_ONCE = 65_536
_INFLUENCE = 0.01  # moves a vertex by 1 mm if two bones would place it 10 cm apart


def measure_weights(avatar: TrainedField, template: MeshTemplate | None) -> dict[str, Any] | None:
    """Compare an avatar's weights with those of the subject's mesh; None if either has none.

    Args:
        avatar: the avatar.
        template: mesh and true weights in the canonical pose.
    """
    if template is None or not avatar.has_skinning_weights:
        return None
    vertices = torch.as_tensor(np.asarray(template.vertices), dtype=torch.float32)
    learned = torch.cat([avatar.skinning_weights(part).cpu() for part in vertices.split(_POINTS_AT_ONCE)])
    return compare_weights(learned.double().numpy(), np.asarray(template.weights, np.float64))


def compare_weights(learned: NDArray, true: NDArray) -> dict[str, Any]:
    """Compare learned weights [V, J] with true ones [V, J] for `metrics.json`; shares from 0 to 1, L1 norm from 0 to 2."""
    share = np.abs(learned - true).sum(1) / 2
    influences, true_influences = learned > _INFLUENCE, true > _INFLUENCE
    right = (influences & true_influences).sum(1)
    return {
        "wrong_share": float(share.mean()),
        "wrong_share_p95": float(np.quantile(share, 0.95)),
        "right_bone": float((learned.argmax(1) == true.argmax(1)).mean()),
        "precision": float((right / influences.sum(1).clip(1)).mean()),
        "recall": float((right / true_influences.sum(1).clip(1)).mean()),
        "l1_norm": float(2 * share.mean()),
        "vertices": len(true),
    }


def weights_text(weights: Mapping[str, Any]) -> str:
    """Return the results of `measure_weights` as two lines."""
    return (
        f"skinning weights at {weights['vertices']:,} vertices: {100 * weights['wrong_share']:.1f} % on wrong bones "
        f"(95 % quantile {100 * weights['wrong_share_p95']:.1f} %), heaviest bone right at {100 * weights['right_bone']:.1f} %"
        f"\ninfluences: precision {100 * weights['precision']:.1f} %, recall {100 * weights['recall']:.1f} %; "
        f"L1 norm {weights['l1_norm']:.3f} per vertex"
    )
