"""The canonical occupancy network f(x, p) of SNARF Eq. 1; it returns logits, positive where occupied."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from snarfcli.networks import ACTIVATIONS, WeightNormLinear, run_encoding, run_perceptron, run_pose_code, run_segment_distance
from snarfcli.shape.features import FeatureGrids

__all__ = ["LOGITS_PER_METRE", "SOFTPLUS_SHARPNESS", "OccupancyNetwork", "ShapeConfig", "part_codes"]

SOFTPLUS_SHARPNESS = 100.0  # as in the papers' code
LOGITS_PER_METRE = 30.0
"""Slope of the capsule prior across its surface."""


@dataclass
class ShapeConfig:
    name: str = "mlp"
    """Canonical shape: mlp (a network alone) or grid (feature grids and a small network)."""
    width: int = 256
    """Width of the hidden layers."""
    depth: int = 8
    """Number of hidden layers."""
    activation: str = "softplus"
    """Activation: softplus (with a sharpness of 100) or relu."""
    skip_layers: list[int] = field(default_factory=lambda: [4])
    """Layers that get the point as an additional input."""
    frequencies: list[float] = field(default_factory=list)
    """Angular frequencies of a sine and cosine encoding of the point, radians per metre; an empty list for no encoding."""
    condition_layer: int | None = 6
    """Layer that gets the pose condition, unless condition.layer is set (as with condition=local); null for no condition."""
    condition_size: int = 8
    """Size of the code to which the pose condition is reduced first, unless condition.size is set."""
    condition_at_start: bool = True
    """Whether the pose has an influence at the start of training; false starts from the same shape in all poses."""
    geometric_init: bool = True
    """Whether the network starts as a sphere with a radius of one metre (Atzmon and Lipman 2020)."""
    weight_norm: bool = True
    """Whether the layers are weight-normalised."""
    feature_cells_m: list[float] = field(default_factory=list)
    """Sides of the cells of feature grids, metres, one grid per number; an empty list for no grids."""
    features: int = 4
    """Number of features per node of a grid, 1 to 16."""
    prior_radius_m: float | None = None
    """Prior of the shape: capsules around the bones with this radius, metres, which the network corrects; null for none."""


class OccupancyNetwork(nn.Module):
    """Pose-conditioned occupancy of canonical points.

    Args:
        config: architecture.
        pose_size: length of the pose condition; 0 for none.
        bones: [S, 2, 3], canonical ends of the bones, metres, for the capsule prior.
        box: corners (lower [3], upper [3]) of the canonical box, metres, which feature grids fill.

    Raises:
        ValueError: a setting of the architecture is out of range.

    The pose condition is an additional input of one layer. Since it is the same for all points of a pose, its part of that
    layer is evaluated once per pose and added as a bias.
    """

    bones: Tensor
    frequencies: Tensor

    def __init__(self, config: ShapeConfig, pose_size: int, bones: Tensor, box: tuple[Tensor, Tensor] | None = None) -> None:
        super().__init__()
        self.config = config
        if config.activation not in ("softplus", "relu"):
            raise ValueError(f"shape.activation: wanted softplus or relu, got {config.activation!r}")
        self.conditioned = config.condition_layer is not None and pose_size > 0
        if config.condition_layer is not None and pose_size > 0 and not 0 <= config.condition_layer < config.depth:
            raise ValueError(f"shape.condition_layer: wanted 0 to {config.depth - 1}, got {config.condition_layer}")
        self.register_buffer("bones", bones.clone())
        self.register_buffer("frequencies", torch.tensor(config.frequencies), persistent=False)
        self.grids: FeatureGrids | None = None
        if config.feature_cells_m:
            if box is None:
                raise ValueError("shape.feature_cells_m: wanted a canonical box for the feature grids, got none")
            self.grids = FeatureGrids(*box, config.feature_cells_m, config.features)
        point_size = 3 + 6 * len(config.frequencies) + (self.grids.size if self.grids is not None else 0)
        self.pose_code = nn.Linear(pose_size, config.condition_size) if self.conditioned else None
        layers = []
        for index in range(config.depth + 1):
            inputs = point_size if index == 0 else config.width
            inputs += point_size if index in config.skip_layers else 0
            joined = config.condition_size if self.conditioned and index == config.condition_layer else 0
            layer = nn.Linear(inputs + joined, config.width if index < config.depth else 1)
            self._initialise(layer, index, joined, point_size)
            layers.append(WeightNormLinear(layer) if config.weight_norm else layer)
        self.layers = nn.ModuleList(layers)

    @property
    def linears(self) -> list[nn.Linear]:
        """The layers, in the order of evaluation."""
        return [layer for layer in self.layers if isinstance(layer, nn.Linear)]

    def _initialise(self, layer: nn.Linear, index: int, joined: int, point_size: int) -> None:
        """Set the initial weights of a layer; its last `joined` inputs are the pose code, those before an encoded point."""
        last = index == self.config.depth
        with torch.no_grad():
            if self.config.geometric_init:
                if last:
                    # The sign is opposite to the source: logits are positive inside, distances negative.
                    layer.weight.normal_(-math.sqrt(math.pi) / math.sqrt(layer.in_features), 1e-4)
                    layer.bias.fill_(1.0)
                else:
                    layer.weight.normal_(0, math.sqrt(2) / math.sqrt(layer.out_features))
                    layer.bias.zero_()
                if index == 0 or index in self.config.skip_layers:
                    # Only the point itself has an influence at first: with waves and features it would not be a sphere.
                    waves = point_size - 3
                    end = layer.in_features - joined
                    layer.weight[:, end - waves : end] = 0
            elif last:
                layer.weight.normal_(0, 1e-2)
                layer.bias.zero_()
            if joined and not self.config.condition_at_start:
                layer.weight[:, -joined:] = 0

    def forward(self, canonical: Tensor, condition: Tensor, pose: Tensor, seen: Tensor | None = None) -> Tensor:
        """Return occupancy logits [M] at canonical points [M, 3], metres.

        Args:
            canonical: [M, 3], metres.
            condition: [B, C], pose condition of each pose.
            pose: [M], index of the pose of each point, 0 to B - 1.
            seen: [M, P], share of each of the P equal parts of the condition at each point; None for all of it.
        """
        extras = None
        if self.pose_code is not None:
            if seen is None:
                extras = self.pose_code(condition).index_select(0, pose)
            else:
                extras = _local_code(self.pose_code, condition, pose, seen)
        count = len(self.linears)
        takes_first = [int(index == 0 or index in self.config.skip_layers) for index in range(count)]
        takes_extras = [int(extras is not None and index == self.config.condition_layer) for index in range(count)]
        weights = [self._weight(index, layer) for index, layer in enumerate(self.linears)]
        biases = [layer.bias for layer in self.linears]
        settings = (takes_first, takes_extras, ACTIVATIONS[self.config.activation], SOFTPLUS_SHARPNESS)
        logits = run_perceptron(self._encode(canonical), extras, weights, biases, *settings)[:, 0]
        if self.config.prior_radius_m is not None:
            distance = run_segment_distance(canonical, self.bones)
            logits = logits + LOGITS_PER_METRE * (self.config.prior_radius_m - distance)
        return logits

    def _weight(self, index: int, layer: nn.Linear) -> Tensor:
        """Return the weight of a layer; where the point joins again, both parts are divided by the square root of two."""
        weight = layer.weight
        if index == 0 or index not in self.config.skip_layers:
            return weight
        joined = self.config.condition_size if self.conditioned and index == self.config.condition_layer else 0
        scale = weight.new_full((weight.shape[1],), 1 / math.sqrt(2))
        scale[weight.shape[1] - joined :] = 1
        return weight * scale

    def _encode(self, canonical: Tensor) -> Tensor:
        """Return points with their sines and cosines, and the features of the grids there, [M, E]."""
        if self.grids is not None:
            return run_encoding(canonical, self.frequencies, *self.grids.arrays)
        return run_encoding(canonical, self.frequencies) if len(self.frequencies) else canonical


def part_codes(pose_code: nn.Linear, condition: Tensor, parts: int) -> Tensor:
    """Return the code [B, P, K] of each of `parts` equal parts of a pose condition [B, C]; the bias is not in it."""
    values = condition.unflatten(1, (parts, -1))  # [B, P, C / P]
    mapping = pose_code.weight.unflatten(1, (parts, -1))  # [K, P, C / P]
    return (values[:, :, None] * mapping.transpose(0, 1)).sum(-1)  # small: faster than a product of matrices


def _local_code(pose_code: nn.Linear, condition: Tensor, pose: Tensor, seen: Tensor) -> Tensor:
    """Return the pose code [M, K] of each point, from the parts of the condition that it sees."""
    return run_pose_code(seen, part_codes(pose_code, condition, seen.shape[1]), pose) + pose_code.bias
