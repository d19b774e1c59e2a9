"""Fully connected networks, encodings of points and distances, as torch.library operators with exact gradients."""

from snarfcli.networks.capsules import run_segment_distance
from snarfcli.networks.encoding import MAX_FEATURES, run_encoding
from snarfcli.networks.perceptron import ACTIVATIONS, run_perceptron
from snarfcli.networks.pose_code import run_pose_code
from snarfcli.networks.weight_norm import WeightNormLinear

__all__ = [
    "ACTIVATIONS",
    "MAX_FEATURES",
    "WeightNormLinear",
    "run_encoding",
    "run_perceptron",
    "run_pose_code",
    "run_segment_distance",
]
