"""Canonical shapes: pose-conditioned occupancy as a function of the canonical point."""

from snarfcli.shape.network import OccupancyNetwork, ShapeConfig

__all__ = ["OccupancyNetwork", "ShapeConfig"]
