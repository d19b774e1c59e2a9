"""Canonical shapes: pose-conditioned occupancy at canonical points."""

from snarfcli.shape.condition import CONDITIONS, ConditionConfig, joints_of_bones
from snarfcli.shape.network import OccupancyNetwork, ShapeConfig

__all__ = ["CONDITIONS", "ConditionConfig", "OccupancyNetwork", "ShapeConfig", "joints_of_bones"]
