"""Read the animations of glTF files, sampled at equal time steps.

Source: Khronos, glTF 2.0 specification, section 3.11 and appendix C (interpolation).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snarfcli.errors import UserError
from snarfcli.formats.gltf_file import GltfFile

__all__ = ["GltfAnimation", "LeftOut", "read_animations"]

LeftOut = list[tuple[str, str]]
"""Name of each animation that cannot be used, and the reason."""

_WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}
_MAX_CHANNELS = 30_000
_MAX_FRAMES = 100_000
# Frames times channels, of all animations. One minute of 100 joints at 30 frames per second is half a million.
_MAX_SAMPLES = 5_000_000
_MAX_NODE_FRAMES = 1_500_000  # less than the limit of `read_gltf`
_DEFAULT_RATE = 30.0
_DECLARED_RATES = (1.0, 1000.0)
# Lower key rates come from keys set by hand, where the interpolation between the keys is part of the motion.
_KEY_RATES = (10.0, 1000.0)
_MAX_OFFSET = 0.05  # frames between a key and its frame; float32 is off by 0.015 in minute 50 at 60 frames per second
# Seconds; shorter steps count as zero, since times are stored as float32.
_EPSILON = 1e-5


@dataclass(frozen=True, eq=False)
class GltfAnimation:
    """Transforms of the moving nodes at equal time steps."""

    name: str
    """Name in the file; may be empty."""
    frame_rate: float
    """Frames per second."""
    num_frames: int
    """Number T of frames, at equal time steps from the first key to the last."""
    nodes: dict[int, dict[str, NDArray[np.float64]]]
    """Per moving node, some of `translation` [T, 3], `rotation` [T, 4] (unit quaternions, x y z w), `scale` [T, 3]."""


@dataclass(frozen=True, eq=False)
class _Track:
    """The channels of an animation, before sampling."""

    name: str
    what: str
    """Name in messages."""
    targets: list[tuple[int, str, dict[str, Any]]]
    """Node, path and sampler of each channel."""
    times: list[NDArray[np.float64]]
    """[K] per channel, times of the keys, seconds."""
    own_rate: float | None
    """Frames per second such that all keys lie on frames; None if unknown."""

    @property
    def start(self) -> float:
        """Time of the first key, seconds."""
        return min(times[0] for times in self.times)

    @property
    def duration(self) -> float:
        """Seconds from the first key to the last."""
        return max(times[-1] for times in self.times) - self.start

    def num_frames(self, frame_rate: float) -> int:
        """Return the number of frames; the last frame is not after the last key."""
        if frame_rate == self.own_rate:  # late times, rounded to float32, may be half a frame early
            return round(self.duration * frame_rate) + 1
        return int(self.duration * frame_rate + _EPSILON * frame_rate + 1e-6) + 1


def read_animations(file: GltfFile, frame_rate: float | None = None) -> tuple[list[GltfAnimation], LeftOut]:
    """Sample every animation that moves a node; those of morph targets are left out, and so are damaged ones, with the reason.

    Args:
        file: the file.
        frame_rate: frames per second; None for the rate of each animation. The rate is then 30 if none is known, or if the
            known one is higher and gives too many frames.

    Raises:
        UserError: there are too many frames.
    """
    tracks, left_out = _read_tracks(file)
    rates = [frame_rate or track.own_rate or _DEFAULT_RATE for track in tracks]
    if frame_rate is None and not _affordable(tracks, rates, len(file.items("nodes"))):
        rates = [min(rate, _DEFAULT_RATE) for rate in rates]
    found, samples = [], 0
    for track, rate in zip(tracks, rates, strict=True):
        start, duration = track.start, track.duration
        if not duration * rate < _MAX_FRAMES:
            file.fail(f"{track.what}: wanted at most {_MAX_FRAMES} frames, got {duration:.6g} s at {rate:g} per second; cut it")
        frames = track.num_frames(rate)
        samples += frames * len(track.targets)
        if samples > _MAX_SAMPLES:
            file.fail(f"its animations have over {_MAX_SAMPLES} samples at {rate:g} frames per second; export fewer")
        try:
            nodes = _sample_nodes(file, track, start + np.minimum(np.arange(frames) / rate, duration))
        except UserError as error:
            left_out.append((track.name or track.what, file.reason(error)))
            continue
        found.append(GltfAnimation(track.name, float(rate), frames, nodes))
    return found, left_out


def _sample_nodes(file: GltfFile, track: _Track, at: NDArray[np.float64]) -> dict[int, dict[str, NDArray[np.float64]]]:
    """Return `GltfAnimation.nodes` at the times `at` [T], seconds."""
    nodes: dict[int, dict[str, NDArray[np.float64]]] = {}
    for (node, path, sampler), keys in zip(track.targets, track.times, strict=True):
        values, mode = _read_values(file, sampler, path, len(keys), track.what)
        sampled = _sample(keys, values, mode, at, path == "rotation")
        if path == "rotation":
            length = np.linalg.norm(sampled, axis=1, keepdims=True)
            if not (length > 1e-12).all():
                file.fail(f"{track.what}: a rotation of node {node} is a zero quaternion; export it again")
            sampled = sampled / length
        nodes.setdefault(node, {})[path] = sampled
    return nodes


def _read_tracks(file: GltfFile) -> tuple[list[_Track], LeftOut]:
    """Read the channels and key times of every animation that moves a node."""
    animations = file.items("animations")
    channels = [channels for animation in animations if isinstance(channels := animation.get("channels"), list)]
    if sum(map(len, channels)) > _MAX_CHANNELS:
        file.fail(f"its animations have over {_MAX_CHANNELS} channels; export fewer of them")
    tracks: list[_Track] = []
    left_out: LeftOut = []
    for number, animation in enumerate(animations):
        name = animation.get("name")
        name = name if isinstance(name, str) else ""
        what = f"animation {number} ({name!a:.40})" if name else f"animation {number}"
        try:
            track = _read_track(file, animation, name, what)
        except UserError as error:
            left_out.append((name or what, file.reason(error)))
            continue
        tracks += [track] if track.targets else []
    return tracks, left_out


def _read_track(file: GltfFile, animation: dict[str, Any], name: str, what: str) -> _Track:
    samplers = file.objects(animation, "samplers", what)
    channels = file.objects(animation, "channels", what)
    targets = [target for channel in channels if (target := _target(file, channel, samplers, what))]
    times = [_read_times(file, sampler, what) for _, _, sampler in targets]
    extras = animation.get("extras")
    declared = extras.get("frame_rate") if isinstance(extras, dict) else None
    return _Track(name, what, targets, times, _own_rate(times, declared) if times else None)


def _own_rate(times: list[NDArray[np.float64]], declared: Any) -> float | None:
    """Return the frames per second such that all keys lie on frames; None if unknown.

    Args:
        times: [K] per channel, times of the keys, seconds.
        declared: the frame rate that the file declares, if any. It is tried first, then the rate of equally spaced keys.
    """
    if type(declared) in (int, float) and _DECLARED_RATES[0] <= declared <= _DECLARED_RATES[1] and _fits(times, declared):
        return float(declared)
    keys = max(times, key=len)
    length = keys[-1] - keys[0]
    if len(keys) < 3 or not length > 0:
        return None
    rate = float((len(keys) - 1) / length)
    rate = round(rate) if abs(rate - round(rate)) < 1e-3 else rate
    return float(rate) if _KEY_RATES[0] <= rate <= _KEY_RATES[1] and _fits(times, rate) else None


def _fits(times: list[NDArray[np.float64]], rate: float) -> bool:
    """Return whether all keys lie on frames, and every frame has a key; channels with keys at both ends only are exempt."""
    start = min(keys[0] for keys in times)
    last = (max(keys[-1] for keys in times) - start) * rate
    if not last < _MAX_FRAMES:
        return False
    taken = np.zeros(round(last) + 1, dtype=bool)
    for keys in times:
        frames = (keys - start) * rate
        nearest = np.rint(frames)
        if (np.abs(frames - nearest) > _MAX_OFFSET).any():
            return False
        taken[nearest.astype(np.int64)] = True
    return bool(taken.all()) or max(map(len, times)) <= 2


def _affordable(tracks: list[_Track], rates: list[float], num_nodes: int) -> bool:
    """Return whether sampling at these rates stays within the limits of this module and of `read_gltf`."""
    frames = [track.duration * rate + 20 for track, rate in zip(tracks, rates, strict=True)]
    samples = sum(count * len(track.targets) for count, track in zip(frames, tracks, strict=True))
    most = max(frames, default=0)
    return most < _MAX_FRAMES and samples < _MAX_SAMPLES and sum(frames) * num_nodes < _MAX_NODE_FRAMES


def _target(
    file: GltfFile, channel: dict[str, Any], samplers: list[dict[str, Any]], what: str
) -> tuple[int, str, dict[str, Any]] | None:
    """Return node, path and sampler of a channel; None if it does not move a node."""
    target = channel.get("target")
    if not isinstance(target, dict):
        file.fail(f"a channel of {what} has no target; export it again")
    path = target.get("path")
    node = file.index(target, "node", "nodes", f"a channel of {what}")
    if node is None or not isinstance(path, str) or path not in _WIDTHS:
        return None
    sampler = channel.get("sampler")
    if type(sampler) is not int or not 0 <= sampler < len(samplers):
        file.fail(f"a channel of {what} has no sampler; export it again")
    return node, path, samplers[sampler]


def _read_times(file: GltfFile, sampler: dict[str, Any], what: str) -> NDArray[np.float64]:
    """Return the times [K] of the keys of a sampler, seconds, K > 0."""
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
    """Return the values [K, width] of a sampler ([K, 3, width] with tangents) and its interpolation."""
    mode = sampler.get("interpolation", "LINEAR")
    if not isinstance(mode, str) or mode not in ("LINEAR", "STEP", "CUBICSPLINE"):
        file.fail(f"{what}: wanted the interpolation LINEAR, STEP or CUBICSPLINE, got another; export it again")
    number = file.index(sampler, "output", "accessors", what)
    if number is None:
        file.fail(f"{what} has a sampler without output; export it again")
    values = file.accessor(number, ("VEC4" if path == "rotation" else "VEC3",), f"values of {what}").astype(np.float64)
    each = 3 if mode == "CUBICSPLINE" else 1
    if len(values) != each * num_keys:
        file.fail(f"{what}: wanted {each * num_keys} values for {num_keys} times, got {len(values)}; export it again")
    return (values.reshape(num_keys, 3, -1) if each == 3 else values), mode


def _sample(
    times: NDArray[np.float64], values: NDArray[np.float64], mode: str, at: NDArray[np.float64], is_rotation: bool
) -> NDArray[np.float64]:
    """Return the values [T, width] at the times `at`; constant before the first key and after the last.

    Args:
        times: [K], times of the keys, seconds.
        values: [K, width], or [K, 3, width] with tangents.
        mode: interpolation.
        at: [T], times of the frames, seconds.
        is_rotation: whether the values are quaternions.
    """
    # A frame that misses its key by rounding belongs to that key; otherwise STEP would show the key before.
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
    """Return the spherical interpolation of the quaternions a and b [T, 4] at u [T, 1], along the shorter arc."""
    a, b = (q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-30) for q in (a, b))
    cosine = (a * b).sum(1, keepdims=True)
    b, cosine = np.where(cosine < 0, -b, b), np.abs(cosine)
    angle = np.arccos(np.minimum(cosine, 1.0))
    is_near = cosine > 1 - 1e-9  # the sine would be zero; linear interpolation is exact enough there
    sine = np.where(is_near, 1.0, np.sin(angle))
    weight_a = np.where(is_near, 1 - u, np.sin((1 - u) * angle) / sine)
    weight_b = np.where(is_near, u, np.sin(u * angle) / sine)
    return weight_a * a + weight_b * b
