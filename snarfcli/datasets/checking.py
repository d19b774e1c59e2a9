"""Is a data set fit to be learned from? What was found, and what is missing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from snarfcli.bodies import Skeleton
from snarfcli.datasets.registry import find_dataset
from snarfcli.datasets.request import DataRequest
from snarfcli.datasets.subjects import SequenceSpec, SubjectData
from snarfcli.errors import UserError
from snarfcli.sampling import check_mesh
from snarfcli.sampling.occupancy import winding_numbers
from snarfcli.segments import distance_to_segments

__all__ = ["ExaminedFrame", "Remark", "check_subject"]

_FRAMES_LOOKED_AT = 3  # of a sequence, which take a second or two
_SEQUENCES_LOOKED_AT = 8
_LISTED = 12
_FRAMES_DRAWN = 4
_VERTICES_MEASURED = 2000
# Of joints inside the mesh. A person's are nearly all, a rigged animal's mostly: its first joint may lie on the ground.
_JOINTS_INSIDE_BAD, _JOINTS_INSIDE_GOOD = 0.25, 0.6
_FAR_FROM_BONES = 0.25  # of the mesh's longest side: half of the vertices further from the bones than this fit no skeleton
_PERSON_M = (0.8, 3.0)


@dataclass(frozen=True)
class Remark:
    """One line about a data set."""

    name: str
    """What it is about, a word or two."""
    text: str
    """What was found, and what to do where something is wrong."""
    kind: Literal["fact", "warning", "problem"] = "fact"
    """A problem has to be mended before the data can be used; a warning is worth a look."""


@dataclass(frozen=True, eq=False)
class ExaminedFrame:
    """A frame whose mesh was read, for a picture."""

    label: str
    """Sequence and number."""
    vertices: np.ndarray
    """[V, 3], metres."""
    faces: np.ndarray
    """[F, 3]."""
    joints: np.ndarray
    """[J, 3], posed joints, metres."""


def check_subject(
    subject: str, request: DataRequest, draw: Callable[[SubjectData, list[ExaminedFrame]], Remark] | None = None
) -> Iterator[Remark]:
    """Yield what there is to say about one subject.

    Nothing that is wrong with the data raises: it becomes the last remark.

    Args:
        subject: its id.
        request: which data set, and where.
        draw: makes a picture of some of its frames and says where it is.
    """
    seen: list[ExaminedFrame] = []
    try:
        data = find_dataset(request.config.name).load(subject, request)
        yield from _about(data, seen)
        if seen and draw is not None:
            some = np.unique(np.linspace(0, len(seen) - 1, _FRAMES_DRAWN).round().astype(int))
            yield draw(data, [seen[index] for index in some])
    except UserError as error:
        yield Remark("not usable", str(error), "problem")
    except Exception as error:  # what a check is for is not to break off
        yield Remark("not usable", f"{type(error).__name__}: {' '.join(str(error).split())[:200]}", "problem")


def _about(data: SubjectData, seen: list[ExaminedFrame]) -> Iterator[Remark]:
    for line in data.sources:
        yield Remark("from", line)
    yield from _about_skeleton(data.skeleton)
    yield from _about_sequences(data)
    looked_at: list[ExaminedFrame] = []
    open_edges: list[int] = []
    some = np.unique(np.linspace(0, len(data.sequences) - 1, _SEQUENCES_LOOKED_AT).round().astype(int))
    for spec in [data.sequences[index] for index in some]:
        if not (np.isfinite(spec.motion.poses).all() and np.isfinite(spec.motion.translation).all()):
            yield Remark(spec.name, "has NaN or infinite poses; repair them", "problem")
            continue
        usable = np.arange(spec.motion.num_frames) if spec.frames is None else spec.frames
        for frame in usable[np.unique(np.linspace(0, len(usable) - 1, _FRAMES_LOOKED_AT).round().astype(int))]:
            label = f"{spec.name}, frame {frame}"
            try:
                vertices, faces = spec.meshes[int(frame)]
                open_edges.append(check_mesh(vertices, faces, name=f"{label}: the mesh"))
            except UserError as error:
                yield Remark("mesh", str(error), "problem")
                continue
            looked_at.append(ExaminedFrame(label, vertices, faces, _posed_joints(data.skeleton, spec, int(frame))))
            seen.append(looked_at[-1])
    if looked_at:
        yield from _about_meshes(looked_at, open_edges)
        yield from _about_fit(data.skeleton, looked_at)


def _about_skeleton(skeleton: Skeleton) -> Iterator[Remark]:
    roots = sum(parent < 0 for parent in skeleton.parents)
    lengths = [float((skeleton.joints_rest[a] - skeleton.joints_rest[b]).norm()) for a, b in skeleton.bones]
    turned = int((skeleton.canonical_pose.abs().amax(1) > 1e-6).sum())
    canonical = f"{turned} joints turned" if turned else "the rest pose"
    tops = f", {roots} roots" if roots > 1 else ""
    yield Remark("skeleton", f"{skeleton.num_joints} joints, {len(lengths)} bones{tops}; canonical pose: {canonical}")
    short = sum(length < 1e-6 for length in lengths)
    if short:
        yield Remark("skeleton", f"{short} bones have no length; that works, but their joints cost weights", "warning")
    if skeleton.num_joints > 100:
        yield Remark("skeleton", "over 100 joints: training takes its time with each; leave out what hardly moves", "warning")


def _about_sequences(data: SubjectData) -> Iterator[Remark]:
    for name, reason in data.broken[:_LISTED]:
        yield Remark("broken", f"{name}: {reason}; mend it, or give skip_broken=true to preprocess", "problem")
    for spec in data.sequences[:_LISTED]:
        kept = ", bone transforms as given" if spec.posed_from_rest is not None else ""
        yield Remark(spec.split, f"{spec.name}: {spec.motion.num_frames} frames at {spec.motion.frame_rate:g} a second{kept}")
    more = len(data.sequences) - _LISTED
    if more > 0:
        yield Remark("", f"and {more} sequences more")
    if not data.of_split("train"):
        yield Remark("train", "no sequence to train on", "problem")
    if not data.of_split("test"):
        yield Remark("test", "no sequence is held out: there will be no IoU in distribution; name one in data.test", "warning")


def _about_meshes(seen: list[ExaminedFrame], open_edges: list[int]) -> Iterator[Remark]:
    counts = [(len(entry.vertices), len(entry.faces)) for entry in seen]
    sides = [float(np.ptp(entry.vertices, axis=0).max()) for entry in seen]
    same = "the same in all" if len(set(counts)) == 1 else f"{min(counts)[0]} to {max(counts)[0]} vertices"
    text = f"{counts[0][0]} vertices, {counts[0][1]} faces, {same} {len(seen)} frames looked at; {_range(sides)} m long"
    yield Remark("meshes", text)
    if any(open_edges):
        share = sum(count > 0 for count in open_edges)
        text = f"{share} of {len(seen)} are open, up to {max(open_edges)} boundary edges: inside is a winding number over 0.5"
        yield Remark("open meshes", text, "warning")
    volumes = [_volume(entry.vertices, entry.faces) for entry in seen]
    if min(volumes) < 0:
        label = seen[int(np.argmin(volumes))].label
        yield Remark("inside out", f"{label} encloses a negative volume; reverse the order of its faces", "problem")
    if not _PERSON_M[0] <= float(np.median(sides)) <= _PERSON_M[1]:
        text = f"{_range(sides)} m is not the size of a person, for which lengths are set; give data.scale=auto"
        yield Remark("size", text, "warning")


def _about_fit(skeleton: Skeleton, seen: list[ExaminedFrame]) -> Iterator[Remark]:
    """Yield whether meshes and skeleton are in the same place."""
    inside, far = [], []
    ends = skeleton.bones + [(joint, joint) for joint in range(skeleton.num_joints)]
    for entry in seen:
        inside.append(winding_numbers(entry.vertices, entry.faces, entry.joints) > 0.5)
        segments = torch.from_numpy(entry.joints)[torch.tensor(ends)]
        some = entry.vertices[:: max(1, len(entry.vertices) // _VERTICES_MEASURED)].astype(np.float64)
        distances = distance_to_segments(torch.from_numpy(some), segments).numpy()
        far.append(float(np.median(distances)) / max(float(np.ptp(entry.vertices, axis=0).max()), 1e-9))
    share = float(np.mean(inside))
    worst = seen[int(np.argmax(far))].label
    near = f"half of the vertices are nearer to a bone than {100 * max(far):.0f} % of the longest side"
    text = f"{100 * share:.0f} % of the joints are inside the meshes, {near} (at worst: {worst})"
    advice = "; are units, axes and frame order of meshes and poses the same? see the figure"
    if share < _JOINTS_INSIDE_BAD or max(far) > _FAR_FROM_BONES:
        yield Remark("fit", text + advice, "problem")
    elif share < _JOINTS_INSIDE_GOOD:
        outside = [skeleton.names[joint] for joint in np.argsort(np.mean(inside, 0), kind="stable")[:4]]
        yield Remark("fit", f"{text}; mostly outside: {', '.join(outside)}{advice}", "warning")
    else:
        yield Remark("fit", text)


def _posed_joints(skeleton: Skeleton, spec: SequenceSpec, frame: int) -> np.ndarray:
    skeleton = skeleton.to(torch.float64)
    if spec.posed_from_rest is not None:
        moved = torch.from_numpy(spec.posed_from_rest[frame])
    else:
        pose, shift = torch.from_numpy(spec.motion.poses[[frame]]), torch.from_numpy(spec.motion.translation[[frame]])
        moved = skeleton.posed_from_rest(pose, shift)[0]
    return (torch.einsum("jrc,jc->jr", moved[:, :3, :3], skeleton.joints_rest) + moved[:, :3, 3]).numpy()


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the volume inside, roughly for an open mesh."""
    corners = (vertices - vertices.mean(axis=0))[faces].astype(np.float64)
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)


def _range(lengths: list[float]) -> str:
    low, high = min(lengths), max(lengths)
    return f"{low:.2f}" if math.isclose(low, high, rel_tol=0.01) else f"{low:.2f} to {high:.2f}"
