"""Curves over time: noise, pulses, hops and interpolation of key values. They depend on time only, not on the frame rate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

__all__ = ["Style", "hop", "pulse", "smooth_noise", "through"]

Array = NDArray[np.float64]

_GRAVITY = 9.81


def smooth_noise(rng: np.random.Generator, t: Array, slowest_hz: float = 0.15, fastest_hz: float = 1.2) -> Array:
    """Return noise [T] of unit standard deviation: seven sines of random phase with amplitudes that fall with frequency."""
    frequencies = np.geomspace(slowest_hz, fastest_hz, 7) * rng.uniform(0.85, 1.15, 7)
    weights = frequencies**-0.5
    weights *= np.sqrt(2 / np.sum(weights**2))
    phases = rng.uniform(0, 2 * np.pi, 7)
    return np.sum(weights[:, None] * np.sin(2 * np.pi * frequencies[:, None] * t + phases[:, None]), 0)


def pulse(phase: Array, centre: float, width: float) -> Array:
    """Return a smooth bump [T] of height 1, once per cycle of `phase` (in cycles); its support is `width` cycles wide."""
    distance = np.abs((phase - centre + 0.5) % 1.0 - 0.5) / (width / 2)
    return np.where(distance < 1, 0.5 + 0.5 * np.cos(np.pi * np.minimum(distance, 1)), 0.0)


def hop(phase: Array, period_s: float, height_m: float) -> tuple[Array, Array]:
    """Return the vertical motion of a hopping body, one hop per cycle of `phase` (in cycles).

    Returns:
        lift: [T], height, metres: a ballistic arc in flight, joined smoothly to a dip on the ground.
        extension: [T], extension of the leg: 1 in flight, 0 in the middle of the contact.
    """
    flight_s = np.sqrt(8 * height_m / _GRAVITY)
    share = min(flight_s / period_s, 0.8)
    height_m = _GRAVITY * (share * period_s) ** 2 / 8
    u = phase % 1.0
    ground = 1 - share
    in_flight = u >= ground
    w = np.where(in_flight, (u - ground) / share, 0.0)
    dip = 4 * height_m * ground / (np.pi * share)
    sunk = np.where(in_flight, 0.0, np.sin(np.pi * np.minimum(u / ground, 1)))
    return np.where(in_flight, 4 * height_m * w * (1 - w), -dip * sunk), 1 - sunk


def through(t: Array, times: Sequence[float] | Array, values: Sequence[float] | Array) -> Array:
    """Return a smooth curve [T] through key values, without overshoot; constant between two equal values."""
    return PchipInterpolator(np.asarray(times, float), np.asarray(values, float))(np.clip(t, times[0], times[-1]))


class Style:
    """Seeded random numbers for the amplitudes, tempos and phases of a motion. The order of the draws must not change."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def around(self, value: float, spread: float = 0.15) -> float:
        """Return `value` times a random factor between 1 - `spread` and 1 + `spread`."""
        return value * (1 + spread * self.rng.uniform(-1, 1))

    def between(self, low: float, high: float) -> float:
        """Return a random number between two."""
        return float(self.rng.uniform(low, high))

    def noise(self, t: Array, size: float, slowest_hz: float = 0.15, fastest_hz: float = 1.2) -> Array:
        """Return smooth noise [T] of standard deviation `size`."""
        return size * smooth_noise(self.rng, t, slowest_hz, fastest_hz)

    def phase(self, t: Array, tempo_hz: float) -> Array:
        """Return the phase [T], in cycles, of a beat with random start; its tempo varies by about 3 %, as in human motion."""
        start = self.rng.uniform()
        return start + tempo_hz * t + 0.025 * smooth_noise(self.rng, t, 0.15, 0.6)
