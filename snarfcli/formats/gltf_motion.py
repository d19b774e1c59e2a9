"""Animations of glTF files, sampled at equal times.

Source: Khronos, glTF 2.0 specification, section 3.11 and appendix C (interpolation).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.formats.gltf_file import GltfFile

__all__ = ["Animation", "read_animations"]

_WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}
_MAX_CHANNELS = 30_000
_MAX_FRAMES = 100_000
# Of all animations together: frames times channels. A minute of 100 joints at 30 frames a second is half a million.
_MAX_SAMPLES = 5_000_000
# Below it a step counts as none: times are stored as float32.
_EPSILON = 1e-5


@dataclass(frozen=True, eq=False)
class Animation:
    """Some nodes over time."""

    name: str
    """Its name in the file, or empty."""
    num_frames: int
    """T, at equal times from the first key to the last."""
    nodes: dict[int, dict[str, NDArray[np.float64]]]
    """For each node that moves, some of `translation` [T, 3], `rotation` [T, 4] (unit quaternions, x y z w), `scale` [T, 3]."""


def read_animations(file: GltfFile, frame_rate: float) -> list[Animation]:
    """Sample every animation that moves a node; those of morph targets are left out.

    Args:
        file: the file.
        frame_rate: frames a second.

    Raises:
        UserError: times that do not increase, broken numbers, or far too many frames.
    """
    found = []
    animations = file.items("animations")
    channels = [file.objects(a, "channels", f"animation {n}") for n, a in enumerate(animations)]
    if sum(map(len, channels)) > _MAX_CHANNELS:
        file.fail(f"its animations have over {_MAX_CHANNELS} channels; export fewer of them")
    samples = 0
    for number, animation in enumerate(animations):
        name = animation.get("name")
        name = name if isinstance(name, str) else ""
        what = f"animation {number} ({name!a:.40})" if name else f"animation {number}"
        samplers = file.objects(animation, "samplers", what)
        targets = [target for channel in channels[number] if (target := _target(file, channel, samplers, what))]
        if not targets:
            continue
        times = [_read_times(file, sampler, what) for _, _, sampler in targets]
        start = min(t[0] for t in times)
        duration = max(t[-1] for t in times) - start
        if not duration * frame_rate < _MAX_FRAMES:
            file.fail(f"{what} lasts {duration:.6g} s, over {_MAX_FRAMES} frames at {frame_rate:g} a second; cut it")
        frames = int(duration * frame_rate + _EPSILON * frame_rate + 1e-6) + 1
        samples += frames * len(targets)
        if samples > _MAX_SAMPLES:
            file.fail(f"its animations have over {_MAX_SAMPLES} samples at {frame_rate:g} frames a second; export fewer")
        at = start + np.minimum(np.arange(frames) / frame_rate, duration)
        nodes: dict[int, dict[str, NDArray[np.float64]]] = {}
        for (node, path, sampler), keys in zip(targets, times, strict=True):
            values, mode = _read_values(file, sampler, path, len(keys), what)
            sampled = _sample(keys, values, mode, at, path == "rotation")
            if path == "rotation":
                length = np.linalg.norm(sampled, axis=1, keepdims=True)
                if not (length > 1e-12).all():
                    file.fail(f"{what}: a rotation of node {node} is a zero quaternion; export it again")
                sampled = sampled / length
            nodes.setdefault(node, {})[path] = sampled
        found.append(Animation(name, frames, nodes))
    return found


def _target(
    file: GltfFile, channel: dict[str, Any], samplers: list[dict[str, Any]], what: str
) -> tuple[int, str, dict[str, Any]] | None:
    """Return node, path and sampler of a channel that moves a node."""
    target = channel.get("target")
    if not isinstance(target, dict):
        file.fail(f"a channel of {what} has no target; export it again")
    path = target.get("path")
    node = file.index(target, "node", "nodes", f"a channel of {what}")
    if node is None or not isinstance(path, str) or path not in _WIDTHS:
        return None
    sampler = channel.get("sampler")
    if type(sampler) is not int or not 0 <= sampler < len(samplers):
        file.fail(f"a channel of {what} names no sampler; export it again")
    return node, path, samplers[sampler]


def _read_times(file: GltfFile, sampler: dict[str, Any], what: str) -> NDArray[np.float64]:
    """Return the times [K] of a sampler's keys, seconds, K > 0."""
    number = file.index(sampler, "input", "accessors", what)
    if number is None:
        file.fail(f"{what} has a sampler without input; export it again")
    times = file.accessor(number, ("SCALAR",), f"times of {what}")[:, 0].astype(np.float64)
    if len(times) == 0 or (np.diff(times) < 0).any():
        file.fail(f"{what} has no times, or times that do not increase; export it again")
    return times


def _read_values(
    file: GltfFile, sampler: dict[str, Any], path: str, num_keys: int, what: str
) -> tuple[NDArray[np.float64], str]:
    """Return the values [K, width] of a sampler (with tangents, [K, 3, width]) and its interpolation."""
    mode = sampler.get("interpolation", "LINEAR")
    if not isinstance(mode, str) or mode not in ("LINEAR", "STEP", "CUBICSPLINE"):
        file.fail(f"{what} has an interpolation that is none of LINEAR, STEP and CUBICSPLINE; export it again")
    number = file.index(sampler, "output", "accessors", what)
    if number is None:
        file.fail(f"{what} has a sampler without output; export it again")
    values = file.accessor(number, ("VEC4" if path == "rotation" else "VEC3",), f"values of {what}").astype(np.float64)
    each = 3 if mode == "CUBICSPLINE" else 1
    if len(values) != each * num_keys:
        file.fail(f"{what} has {num_keys} times and {len(values)} values; export it again")
    return (values.reshape(num_keys, 3, -1) if each == 3 else values), mode


def _sample(
    times: NDArray[np.float64], values: NDArray[np.float64], mode: str, at: NDArray[np.float64], is_rotation: bool
) -> NDArray[np.float64]:
    """Return [T, width] values at the times `at`; before the first key and after the last they are held."""
    # A frame that misses its key by rounding belongs to it: with STEP it would show the key before.
    left = np.clip(np.searchsorted(times, at + _EPSILON, "right") - 1, 0, len(times) - 1)
    right = np.minimum(left + 1, len(times) - 1)
    step = times[right] - times[left]
    u = (np.clip(at, times[0], times[-1]) - times[left]) / np.where(step > 0, step, 1.0)
    u = np.clip(u, 0.0, 1.0)[:, None]
    if mode == "STEP":
        return values[left]
    if mode == "CUBICSPLINE":
        tangent_in, point, tangent_out = np.moveaxis(values, 1, 0)
        out, into = step[:, None] * tangent_out[left], step[:, None] * tangent_in[right]
        u2, u3 = u**2, u**3
        return (
            (2 * u3 - 3 * u2 + 1) * point[left] + (u3 - 2 * u2 + u) * out + (3 * u2 - 2 * u3) * point[right] + (u3 - u2) * into
        )
    if is_rotation:
        return _slerp(values[left], values[right], u)
    return (1 - u) * values[left] + u * values[right]


def _slerp(a: NDArray[np.float64], b: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the quaternions between a and b [T, 4] at u [T, 1], the short way round."""
    a, b = (q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-30) for q in (a, b))
    cosine = (a * b).sum(1, keepdims=True)
    b, cosine = np.where(cosine < 0, -b, b), np.abs(cosine)
    angle = np.arccos(np.minimum(cosine, 1.0))
    is_near = cosine > 1 - 1e-9  # the sine would be zero; a straight line is exact enough there
    sine = np.where(is_near, 1.0, np.sin(angle))
    weight_a = np.where(is_near, 1 - u, np.sin((1 - u) * angle) / sine)
    weight_b = np.where(is_near, u, np.sin(u * angle) / sine)
    return weight_a * a + weight_b * b
