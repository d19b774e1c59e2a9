"""Check whether a data set can be used for training: list what was found and what is missing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from snarfcli.bodies import Skeleton
from snarfcli.datasets.pose_consistency import measure_pose_consistency
from snarfcli.datasets.registry import find_dataset
from snarfcli.datasets.sources import Request
from snarfcli.datasets.subject_size import subject_length
from snarfcli.datasets.subjects import SequenceSpec, SubjectData
from snarfcli.errors import UserError
from snarfcli.sampling import check_mesh
from snarfcli.sampling.occupancy import winding_numbers
from snarfcli.segments import distance_to_segments
from snarfcli.texts import counted, one_line

__all__ = ["ExaminedFrame", "Remark", "check_subject"]

_EXAMINED_FRAMES = 3  # per sequence; takes one or two seconds
_EXAMINED_SEQUENCES = 8
_LISTED = 12
_FRAMES_DRAWN = 4
_VERTICES_MEASURED = 2000
# Share of joints inside the mesh: nearly all for a person, most for a rigged animal, whose first joint may be on the ground.
_JOINTS_INSIDE_BAD, _JOINTS_INSIDE_GOOD = 0.25, 0.6
# Median distance of vertices to bones, as a share of the mesh's longest side, above which they do not fit.
_FAR_FROM_BONES = 0.25
# How far the surface near a bone may move between frames, as a share of the mesh's longest side. Measured on 15 subjects
# (built-in, clothed, stick, rigged): at most 0.1 % with correct poses, over 0.6 % with 2 degrees per joint and 1 cm of noise.
_MOVED_AT_BONES = 0.004
_PERSON_M = (0.8, 3.0)


@dataclass(frozen=True)
class Remark:
    """One line about a data set."""

    name: str
    """Topic, one or two words."""
    text: str
    """What was found, and what to do if something is wrong."""
    kind: Literal["fact", "warning", "problem"] = "fact"
    """A problem must be fixed before the data can be used; a warning should be checked."""


@dataclass(frozen=True, eq=False)
class ExaminedFrame:
    """A frame whose mesh was read, for a figure."""

    label: str
    """Name of the sequence and index of the frame."""
    vertices: np.ndarray
    """[V, 3], metres."""
    faces: np.ndarray
    """[F, 3], triangles."""
    joints: np.ndarray
    """[J, 3], posed joints, metres."""
    posed_from_rest: np.ndarray
    """[J, 4, 4], bone transforms, rest to posed, metres."""


def check_subject(
    subject: str, request: Request, draw: Callable[[SubjectData, list[ExaminedFrame]], Remark] | None = None
) -> Iterator[Remark]:
    """Yield remarks about one subject.

    Errors in the data do not raise; they become the last remark.

    Args:
        subject: id of the subject.
        request: the data set and its folders.
        draw: draws some frames, and returns a remark with the path of the figure.
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
    except Exception as error:  # a check must report any error instead of raising it
        yield Remark("not usable", f"{type(error).__name__}: {one_line(str(error), 200)}", "problem")


def _about(data: SubjectData, seen: list[ExaminedFrame]) -> Iterator[Remark]:
    for line in data.sources:
        yield Remark("from", line)
    for line in data.warnings:
        yield Remark("check", line, "warning")
    yield from _about_skeleton(data.skeleton)
    yield from _about_sequences(data)
    examined: list[ExaminedFrame] = []
    open_edges: list[int] = []
    some = np.unique(np.linspace(0, len(data.sequences) - 1, _EXAMINED_SEQUENCES).round().astype(int))
    for spec in [data.sequences[index] for index in some]:
        if not (np.isfinite(spec.motion.poses).all() and np.isfinite(spec.motion.translation).all()):
            yield Remark(spec.name, "wanted finite poses, got NaN or infinity; repair them", "problem")
            continue
        usable = spec.every(1)
        for frame in usable[np.unique(np.linspace(0, len(usable) - 1, _EXAMINED_FRAMES).round().astype(int))]:
            label = f"{spec.name}, frame {frame}"
            try:
                vertices, faces = spec.meshes[int(frame)]
                open_edges.append(check_mesh(vertices, faces, name=f"{label}: the mesh"))
            except UserError as error:
                yield Remark("mesh", str(error), "problem")
                continue
            examined.append(ExaminedFrame(label, vertices, faces, *_posed_bones(data.skeleton, spec, int(frame))))
            seen.append(examined[-1])
    if examined:
        yield from _about_meshes(examined, open_edges)
        if data.template is None:  # else weights say what moves with the bones
            yield from _about_surroundings(data.skeleton, examined)
        fit = _about_fit(data.skeleton, examined)
        yield fit
        if fit.kind != "problem":
            yield from _about_poses(data.skeleton, examined)


def _about_skeleton(skeleton: Skeleton) -> Iterator[Remark]:
    roots = sum(parent < 0 for parent in skeleton.parents)
    lengths = [float((skeleton.joints_rest[a] - skeleton.joints_rest[b]).norm()) for a, b in skeleton.bones]
    turned = int((skeleton.canonical_pose.abs().amax(1) > 1e-6).sum())
    canonical = f"{counted(turned, 'joint')} turned" if turned else "the rest pose"
    tops = f", {roots} roots" if roots > 1 else ""
    joints, bones = counted(skeleton.num_joints, "joint"), counted(len(lengths), "bone")
    yield Remark("skeleton", f"{joints}, {bones}{tops}; canonical pose: {canonical}")
    short = sum(length < 1e-6 for length in lengths)
    if short:
        text = f"{counted(short, 'bone')} of length 0; this works, but their joints need weights and time"
        yield Remark("skeleton", text, "warning")
    if skeleton.num_joints > 100:
        text = "over 100 joints: the time of training grows with each; leave out joints that hardly move"
        yield Remark("skeleton", text, "warning")


def _about_sequences(data: SubjectData) -> Iterator[Remark]:
    for name, reason in data.broken[:_LISTED]:
        yield Remark("broken", f"{name}: {reason}; repair it, or give skip_broken=true to preprocess", "problem")
    for spec in data.sequences[:_LISTED]:
        kept = ", bone transforms as given" if spec.posed_from_rest is not None else ""
        text = f"{spec.name}: {counted(spec.motion.num_frames, 'frame')} at {spec.motion.frame_rate:g} per second{kept}"
        yield Remark(spec.split, text)
    more = len(data.sequences) - _LISTED
    if more > 0:
        yield Remark("", f"and {counted(more, 'more sequence')}")
    if not data.of_split("train"):
        yield Remark("train", "no sequence to train on; add one, or hold out fewer in data.test", "problem")
    if not data.of_split("test"):
        yield Remark("test", "no sequence is held out, so no IoU in distribution; name one in data.test", "warning")


def _about_meshes(seen: list[ExaminedFrame], open_edges: list[int]) -> Iterator[Remark]:
    counts = [(len(entry.vertices), len(entry.faces)) for entry in seen]
    sides = [float(np.ptp(entry.vertices, axis=0).max()) for entry in seen]
    same = "the same in all" if len(set(counts)) == 1 else f"{min(counts)[0]} to {max(counts)[0]} vertices in"
    examined = f"{counted(len(seen), 'frame')} examined"
    text = f"{counts[0][0]} vertices, {counts[0][1]} faces, {same} {examined}; {_range(sides)} m long"
    yield Remark("meshes", text)
    if any(open_edges):
        share = sum(count > 0 for count in open_edges)
        text = f"{share} of {len(seen)} are open, up to {max(open_edges)} boundary edges; inside is a winding number above 0.5"
        yield Remark("open meshes", text, "warning")
    volumes = [_volume(entry.vertices, entry.faces) for entry in seen]
    if min(volumes) < 0:
        label = seen[int(np.argmin(volumes))].label
        yield Remark("inside out", f"{label} encloses a negative volume; reverse the order of its faces", "problem")
    if not _PERSON_M[0] <= float(np.median(sides)) <= _PERSON_M[1]:
        text = f"{_range(sides)} m is not the size of a person, for which the settings are made; give data.scale=auto"
        yield Remark("size", text, "warning")


def _about_surroundings(skeleton: Skeleton, seen: list[ExaminedFrame]) -> Iterator[Remark]:
    """Yield whether the meshes show more than the subject."""
    for entry in seen:
        length, whole = subject_length(entry.vertices, entry.joints, skeleton.parents)
        if length < whole:
            text = f"{entry.label} is {whole:.2f} m long, but {length:.2f} m near the bones: a floor or other things"
            yield Remark("surroundings", f"{text}, which would be learned as a part of the subject; cut them off", "warning")
            return


def _about_fit(skeleton: Skeleton, seen: list[ExaminedFrame]) -> Remark:
    """Return whether meshes and skeleton are at the same place."""
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
    near = f"half of the vertices are closer to a bone than {100 * max(far):.0f} % of the longest side"
    text = f"{100 * share:.0f} % of the joints are inside the meshes, {near} (worst: {worst})"
    advice = "; check that units, axes and frame order of meshes and poses agree; see the figure"
    if share < _JOINTS_INSIDE_BAD or max(far) > _FAR_FROM_BONES:
        return Remark("fit", text + advice, "problem")
    if share < _JOINTS_INSIDE_GOOD:
        outside = [skeleton.names[joint] for joint in np.argsort(np.mean(inside, 0), kind="stable")[:4]]
        return Remark("fit", f"{text}; mostly outside: {', '.join(outside)}{advice}", "warning")
    return Remark("fit", text)


def _about_poses(skeleton: Skeleton, seen: list[ExaminedFrame]) -> Iterator[Remark]:
    """Yield whether the poses fit the meshes frame by frame."""
    fit = measure_pose_consistency(skeleton, seen)
    if fit is None:
        return
    moved, allowed = (f"{100 * length:.1f} cm" for length in (fit.moved_m, _MOVED_AT_BONES * fit.length_m))
    seen_in = f"{counted(fit.bones, 'bone')}, {counted(fit.frames, 'frame')}"
    text = f"surface at a bone moves by {moved} between frames (median of {seen_in})"
    if fit.moved_m < _MOVED_AT_BONES * fit.length_m:
        yield Remark("poses", text)
    else:
        advice = "training.refine_poses=true corrects the poses while training; or repair them, or check the order of frames"
        yield Remark("poses", f"{text}, wanted less than {allowed}; {advice}", "warning")


def _posed_bones(skeleton: Skeleton, spec: SequenceSpec, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the joints [J, 3] and the bone transforms [J, 4, 4], rest to posed, of a frame, metres."""
    skeleton = skeleton.to(torch.float64)
    if spec.posed_from_rest is not None:
        moved = torch.from_numpy(spec.posed_from_rest[frame])
    else:
        pose, shift = torch.from_numpy(spec.motion.poses[[frame]]), torch.from_numpy(spec.motion.translation[[frame]])
        moved = skeleton.posed_from_rest(pose, shift)[0]
    joints = torch.einsum("jrc,jc->jr", moved[:, :3, :3], skeleton.joints_rest) + moved[:, :3, 3]
    return joints.numpy(), moved.numpy()


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the enclosed volume, cubic metres; approximate for an open mesh."""
    corners = (vertices - vertices.mean(axis=0))[faces].astype(np.float64)
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)


def _range(lengths: list[float]) -> str:
    low, high = min(lengths), max(lengths)
    return f"{low:.2f}" if math.isclose(low, high, rel_tol=0.01) else f"{low:.2f} to {high:.2f}"
