"""Subjects that users provide: posed meshes with a skeleton and poses, or rigged files.

A subject is in `<data_root>/meshes`, or in the folder `data.folder`, in one of four forms.

One rigged file (glTF, also VRM) with skeleton, skin and animations, each of which is a sequence:

    fox.glb

Several rigged files with one skeleton; the mesh is that of the first file that has one, the animations are those of all files:

    fox/*.glb

A skeleton and one folder per sequence:

    fox/skeleton.json           a skeleton: names, parents, joints_rest (see skeleton_files); or skeleton.npz, or skeleton.bvh
    fox/<sequence>/poses.npz    poses or bone transforms, one per frame; or poses.json, or motion.bvh
    fox/<sequence>/*.obj        the posed meshes, one file per frame in the order of their names (.ply, .off, .stl, .glb, ...);
                                or points, around which surfaces are closed (.ply, .obj, .xyz, .npy, ...)

A single sequence, whose poses and meshes are in the same folder as the skeleton:

    fox/skeleton.json, fox/poses.npz, fox/*.obj

If there is no skeleton file, the skeleton is read from the motion.bvh of a sequence. The numbers of vertices and faces may
differ between frames. Frames that a pose file does not trust are left out, unless data.untrusted is set.

Held-out sequences are listed, by name or pattern, in `fox/split.json`, or in data.test and data.ood. Otherwise, sequences
whose names start with `ood` are out of distribution, and the last fifth of the others (at least one) is for testing;
`choose_splits` says what is done about rest poses and sequences with the same poses. If there is only one sequence, the last
fifth of its frames is for testing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies.skeleton import Skeleton, legs_apart_pose
from snarfcli.bodies.template import MeshTemplate
from snarfcli.checks import check_choice
from snarfcli.datasets.frame_surfaces import read_frame_surface, read_frame_vertices
from snarfcli.datasets.mesh_folders import (
    POSE_SUFFIXES,
    WANTED,
    files_with,
    find_subject,
    frame_files,
    meshes_folder,
    missing_parts,
    pose_file,
    rigged_files,
    skeleton_files,
    subfolders,
    subject_places,
)
from snarfcli.datasets.posed_meshes import FileMeshes, RigMeshes
from snarfcli.datasets.recorded_sequence import FileToWorld, RecordedSequence, check_scale, person_scale
from snarfcli.datasets.recorded_splits import choose_splits, split_patterns
from snarfcli.datasets.rigged import bvh_poses, bvh_skeleton, read_rigged_files
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.skeleton_files import SkeletonFile, read_poses, read_skeleton
from snarfcli.datasets.sources import Request
from snarfcli.datasets.splits import SPLITS
from snarfcli.datasets.subject_size import subject_length
from snarfcli.datasets.subjects import SubjectData
from snarfcli.errors import UserError
from snarfcli.names import folder_names
from snarfcli.texts import counted

__all__ = ["load", "subjects"]


def subjects(request: Request) -> tuple[str, ...]:
    """Return the names of all subjects.

    Raises:
        UserError: the folder does not exist or has no subject.
    """
    found = subject_places(request)
    if not found:
        folder = meshes_folder(request)
        reasons = [f"; {missing_parts(child)}" for child in subfolders(folder)]
        raise UserError(f"no subject in {folder}{reasons[0] if reasons else ''}; wanted {WANTED}; see data/README.md")
    return tuple(found)


def load(subject: str, request: Request) -> SubjectData:
    """Read one subject.

    Raises:
        UserError: it does not exist, a part is missing or damaged, or a setting does not fit. Sequences that cannot be used are
            listed in `broken` instead, unless there are no others.
    """
    config = request.config
    _check_settings(config)
    place = find_subject(subject, request)
    rigged = rigged_files(place)
    if rigged:
        return _load_rigged(subject, place, rigged, config)
    return _load_meshes(subject, place, config)


# ---------------------------------------------------------------- one mesh file per frame
def _load_meshes(subject: str, folder: Path, config: DataConfig) -> SubjectData:
    """Read a subject that has a skeleton and one mesh file per frame."""
    sequences = [path for path in subfolders(folder) if frame_files(path) or files_with(path, POSE_SUFFIXES)]
    sequences = sequences or [folder]
    source, skeleton = _read_skeleton(folder, sequences)
    recordings, broken = [], []
    names = folder_names(path.name if path != folder else subject for path in sequences)
    for name, path in zip(names, sequences, strict=True):
        try:
            recordings.append(_read_recording(name, path, skeleton, use_all=config.untrusted))
        except UserError as error:
            broken.append((name, str(error)))
    if not recordings:
        more = f" (and {len(broken) - 1} more sequences cannot be used)" if broken[1:] else ""
        raise UserError(broken[0][1] + more)
    vertices, joints, is_cloud = _first_mesh(recordings, skeleton)
    length, whole = subject_length(vertices, joints, skeleton.parents)
    scale, why = person_scale(length, whole, config.scale, skeleton.scale)
    up = config.up if config.up != "auto" else skeleton.up or "y"
    warnings = _about_angles(recordings)
    sources = (f"skeleton {source}, {counted(len(skeleton.names), 'joint')}", _conversion_text(why, up))
    sources += ("points without faces: a closed surface is put around those of each frame",) if is_cloud else ()
    sources += _about_trust(recordings)
    return _subject(
        subject, skeleton, FileToWorld(scale, up), recordings, folder, config, sources, warnings, broken=tuple(broken)
    )


def _read_skeleton(folder: Path, sequences: list[Path]) -> tuple[Path, SkeletonFile]:
    """Return the file of the skeleton, and the skeleton."""
    files = skeleton_files(folder)
    if len(files) > 1:
        raise UserError(f"{folder}: wanted one skeleton, got {files[0].name} and {files[1].name}; remove one")
    if not files:
        files = [path / "motion.bvh" for path in (folder, *sequences) if (path / "motion.bvh").is_file()][:1]
    if not files:
        raise UserError(f"{folder}: wanted a skeleton file or a motion.bvh, got neither; see data/README.md")
    path = files[0]
    return path, bvh_skeleton(path) if path.suffix == ".bvh" else read_skeleton(path)


def _read_recording(name: str, folder: Path, skeleton: SkeletonFile, *, use_all: bool) -> RecordedSequence:
    """Read the poses of one sequence, and list its mesh files, which are not read yet.

    Args:
        name: name of the sequence.
        folder: its folder.
        skeleton: skeleton of the subject.
        use_all: use also frames that the pose file does not trust.
    """
    path = pose_file(folder)
    poses = bvh_poses(path, skeleton) if path.suffix.lower() == ".bvh" else read_poses(path, skeleton.order)
    meshes = [file for file in frame_files(folder) if file != path]
    if len(meshes) != poses.num_frames:
        wanted = f"{poses.num_frames} meshes, one per frame of {path.name}"
        raise UserError(f"{folder}: wanted {wanted}, got {len(meshes)}; add or remove files")
    if use_all:
        poses = replace(poses, is_trusted=None)
    if poses.is_trusted is not None and not poses.is_trusted.any():
        raise UserError(f"{path}: none of its {counted(poses.num_frames, 'frame')} is trusted; data.untrusted=true uses them")
    files = FileMeshes(meshes, partial(read_frame_surface, parents=skeleton.parents), np.eye(4))
    recording = RecordedSequence(name, poses, files)
    joints = recording.joints(np.arange(len(files)), skeleton)
    return replace(recording, meshes=replace(files, joints=joints))


def _about_trust(recordings: list[RecordedSequence]) -> tuple[str, ...]:
    """Return a line about the frames that are left out because their poses are not trusted."""
    counts = {each.name: (each.poses.num_frames - len(each.usable_frames), each.poses.num_frames) for each in recordings}
    some = [f"{name} {count} of {frames}" for name, (count, frames) in counts.items() if count]
    if not some:
        return ()
    listed = ", ".join(some[:12]) + (", ..." if some[12:] else "")
    total = counted(sum(count for count, _ in counts.values()), "frame")
    return (f"{total} left out, whose poses are not trusted ({listed}); data.untrusted=true uses them",)


def _about_angles(recordings: list[RecordedSequence]) -> tuple[str, ...]:
    """Return lines about angles that are hardly in radians, although not all frames say so."""
    found = []
    for recording in recordings:
        poses = recording.poses.poses
        largest = np.linalg.norm(poses[:, 1:], axis=-1).max(initial=0.0) if poses is not None else 0.0
        if largest > 2 * math.pi:
            found.append(
                f"{recording.name}: a joint is turned by {largest:.3g}, more than a full turn; angles must be in radians"
            )
    return tuple(found)


def _first_mesh(recordings: list[RecordedSequence], skeleton: SkeletonFile) -> tuple[NDArray, NDArray, bool]:
    """Return the vertices or points [V, 3] and joints [J, 3], units of the file, of the first usable frame of a sequence.

    The last value is whether they are points only. Sequences are tried in order until one has a first mesh that can be read.
    """
    problem = None
    for recording in recordings:
        try:
            frame = int(recording.usable_frames[0])
            vertices, is_cloud = read_frame_vertices(Path(recording.meshes.source(frame)))
            if len(vertices) and np.isfinite(vertices).all():
                return vertices, recording.joints(np.array([frame]), skeleton)[0], is_cloud
        except UserError as error:
            problem = problem or error
    raise problem or UserError(f"the first meshes of all {len(recordings)} sequences are empty or not finite; repair them")


# ---------------------------------------------------------------- rigged files
def _load_rigged(subject: str, place: Path, paths: list[Path], config: DataConfig) -> SubjectData:
    """Read a subject from rigged files; `place` is the file, or the folder with the files."""
    rigged = read_rigged_files(paths)
    if not rigged.clips and rigged.left_out:
        raise UserError(f"{place}: no motion can be used; {rigged.left_out[0][0]}: {rigged.left_out[0][1]}; export it again")
    if not rigged.clips:
        raise UserError(f"{place} has no animations, but an avatar is learned from them; export the file with its animations")
    skeleton, mesh = rigged.skeleton, rigged.mesh
    length = float(np.ptp(mesh.vertices, axis=0).max())
    scale, why = person_scale(length, length, config.scale, None)
    up = config.up if config.up != "auto" else "y"  # glTF files have y up
    world = FileToWorld(scale, up)
    vertices = world.points(mesh.vertices)
    names = folder_names(name for name, _ in rigged.clips)
    recordings = []
    for name, (_, poses) in sorted(zip(names, rigged.clips, strict=True), key=lambda pair: pair[0]):
        assert poses.posed_from_rest is not None  # rigged files always give bone transforms
        transforms = world.transforms(poses.posed_from_rest)
        recordings.append(RecordedSequence(name, poses, RigMeshes(vertices, mesh.faces, mesh.weights, transforms)))
    files = str(place) if len(paths) == 1 else f"{len(paths)} files in {place}"
    joints, motions = counted(len(skeleton.names), "joint"), counted(len(recordings), "motion")
    sources = [f"rigged file {files}: {joints}, {len(mesh.vertices)} vertices, {motions}"]
    if rigged.dropped:
        some = ", ".join(rigged.dropped[:4]) + (", ..." if len(rigged.dropped) > 4 else "")
        sources.append(f"left out {counted(len(rigged.dropped), 'end joint')} without vertices ({some})")
    if skeleton.idle:
        some = ", ".join(skeleton.names[joint] for joint in skeleton.idle[:4]) + (", ..." if len(skeleton.idle) > 4 else "")
        sources.append(f"joints that only place others, and move no vertex, get no weights and no shape: {some}")
    sources.append(_conversion_text(why, up))
    template = partial(_template, vertices, mesh.faces, mesh.weights)
    left_out = tuple(f"motion {name} was left out: {reason}" for name, reason in rigged.left_out)
    return _subject(subject, skeleton, world, recordings, place, config, tuple(sources), left_out, template=template)


def _template(vertices: NDArray, faces: NDArray, weights: NDArray, skeleton: Skeleton) -> MeshTemplate:
    """Return the mesh of a rig, given in the rest pose, in the canonical pose."""
    canonical_from_rest = skeleton.posed_from_rest(skeleton.canonical_pose[None]).numpy()
    canonical, _ = RigMeshes(vertices, faces, weights, canonical_from_rest)[0]
    return MeshTemplate(canonical, faces.astype(np.int32), weights)


# ---------------------------------------------------------------- all forms
def _subject(
    subject: str,
    skeleton_file: SkeletonFile,
    world: FileToWorld,
    recordings: list[RecordedSequence],
    place: Path,
    config: DataConfig,
    sources: tuple[str, ...],
    warnings: tuple[str, ...],
    *,
    template: Callable[[Skeleton], MeshTemplate] | None = None,
    broken: tuple[tuple[str, str], ...] = (),
) -> SubjectData:
    """Put a subject together: choose the splits of its sequences, and convert everything to metres and y up.

    Args:
        subject: name of the subject.
        skeleton_file: skeleton in the units and axes of the files.
        world: conversion from these units and axes.
        recordings: sequences that can be used.
        place: file or folder of the subject.
        config: settings.
        sources: lines about the origin of the data.
        warnings: lines about what should be checked.
        template: makes the mesh in the canonical pose from the converted skeleton; None if there is no such mesh.
        broken: name of each sequence that cannot be used, and the reason.
    """
    skeleton = _world_skeleton(skeleton_file, world, config.canonical)
    test, ood = split_patterns(place, config)
    chosen = choose_splits(recordings, (name for name, _ in broken), skeleton_file, test, ood)
    sequences = (recording.to_sequence(chosen.splits[recording.name], skeleton, world) for recording in chosen.recordings)
    specs = {spec.name: spec for spec in sequences}
    stretched = [name for name, spec in specs.items() if spec.posed_from_rest is not None]
    if stretched:
        sources += (f"joints stretch, scale or come apart in {', '.join(stretched[:6])}: bone transforms are kept as given",)
    ordered = sorted(specs.values(), key=lambda spec: SPLITS.index(spec.split))
    mesh = template(skeleton) if template is not None else None
    sources, warnings = (*sources, *chosen.facts), (*warnings, *chosen.warnings)
    return SubjectData("meshes", subject, skeleton, tuple(ordered), mesh, sources=sources, warnings=warnings, broken=broken)


def _world_skeleton(file: SkeletonFile, world: FileToWorld, canonical: str) -> Skeleton:
    """Return the skeleton in metres and y up; `canonical` is the setting data.canonical."""
    rest = torch.from_numpy(world.points(file.joints_rest))
    pose = torch.zeros_like(rest)
    if canonical == "legs_apart":
        if not {"l_hip", "r_hip"} <= set(file.names):
            raise UserError("data.canonical=legs_apart: wanted joints named l_hip and r_hip, got at most one of them; use rest")
        pose = legs_apart_pose(file.names, torch.float64)
    elif canonical == "auto" and file.canonical_pose is not None:
        pose = torch.from_numpy(world.angles(file.canonical_pose))
    return Skeleton(file.names, file.parents, rest, pose, file.idle)


def _conversion_text(why: str, up: str) -> str:
    """Return a line about the conversion of the files; `why` is the reason for the scale, `up` the up axis of the files."""
    return why + ("" if up == "y" else f"; rotated from {up} up to y up")


def _check_settings(config: DataConfig) -> None:
    check_choice("data.up", config.up, ("auto", "y", "z"))
    check_choice("data.canonical", config.canonical, ("auto", "rest", "legs_apart"))
    check_scale(config.scale)
