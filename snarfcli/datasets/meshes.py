"""Subjects of the user's own: posed meshes with a skeleton and poses, or a rigged file.

A subject lies in `<data_root>/meshes`, or in the folder that `data.folder` names, in one of three forms:

    fox.glb                     a rigged file (glTF): skeleton, skin and animations are read from it, each animation a sequence
    fox/*.glb                   several of one skeleton: the mesh of the first that has one, the animations of all

    fox/skeleton.json           a skeleton: names, parents, joints_rest (see skeleton_files), or skeleton.npz, or skeleton.bvh
    fox/<sequence>/poses.npz    poses or bone transforms, one a frame; or poses.json, or motion.bvh
    fox/<sequence>/*.obj        the posed meshes, one file a frame in the order of their names (.ply, .off, .stl, .glb, ...)

    fox/skeleton.json ...       poses and meshes beside the skeleton: one sequence

Without a skeleton file the sequences' motion.bvh say what the skeleton is. The numbers of vertices and faces may change from
frame to frame. `fox/split.json`, or data.test and data.ood, say which sequences are held out: lists of names or patterns. Else
names that start with `ood` are out of distribution and the last fifth of the other sequences (at least one) is for testing;
of an only sequence the last fifth of its frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from snarfcli.bodies.skeleton import Skeleton, legs_apart_pose
from snarfcli.bodies.template import MeshTemplate
from snarfcli.checks import check_choice
from snarfcli.datasets.posed_meshes import FileMeshes, RigMeshes
from snarfcli.datasets.recorded_sequence import Recording, World, person_scale
from snarfcli.datasets.request import DataRequest
from snarfcli.datasets.rigged import RIG_SUFFIXES, bvh_poses, bvh_skeleton, read_rigged_files
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.skeleton_files import SkeletonFile, read_poses, read_skeleton
from snarfcli.datasets.splits import SPLITS, split_sequences
from snarfcli.datasets.subjects import SubjectData
from snarfcli.errors import UserError, nearest
from snarfcli.files import read_json
from snarfcli.formats.surfaces import list_surfaces, read_surface
from snarfcli.names import folder_names

__all__ = ["load", "subjects"]

_SCALES = (1e-6, 1e6)  # metres a unit: from micrometres to what nobody has modelled
_SKELETON_FILES = ("skeleton.json", "skeleton.npz", "skeleton.bvh")
_POSE_FILES = ("poses.npz", "poses.json", "motion.bvh")
_POSE_SUFFIXES = (".npz", ".json", ".bvh")
_NO_POSES = ("split.json", *_SKELETON_FILES)
_WANTED = "a rigged <subject>.glb, or <subject>/ with skeleton.json and a folder of meshes and poses a sequence"


def subjects(request: DataRequest) -> tuple[str, ...]:
    """Return the names of the subjects in the folder.

    Raises:
        UserError: there is no such folder, or no subject in it.
    """
    found = _places(request)
    if not found:
        folder = _folder(request)
        reasons = [f"; {_what_is_missing(child)}" for child in _subfolders(folder)]
        raise UserError(f"no subject in {folder}{reasons[0] if reasons else ''}; wanted {_WANTED}; see data/README.md")
    return tuple(found)


def load(subject: str, request: DataRequest) -> SubjectData:
    """Read one subject.

    Raises:
        UserError: it is not there, something is missing or broken, a setting does not fit. Sequences that cannot be used are
            in `broken` instead, unless there is no other.
    """
    config = request.config
    _check(config)
    place = _find(subject, request)
    rigged = _rigged_files(place)
    if rigged:
        return _load_rigged(subject, place, rigged, config)
    return _load_meshes(subject, place, config)


# ---------------------------------------------------------------- where things are
def _folder(request: DataRequest) -> Path:
    folder = request.folder if request.config.folder is not None else request.data_root / "meshes"
    if not folder.is_dir():
        kind = "is no folder" if folder.exists() else "is not there"
        raise UserError(f"the folder of meshes {folder} {kind}; give data.folder=FOLDER with {_WANTED}")
    return folder


def _places(request: DataRequest) -> dict[str, Path]:
    """Return where each subject is: a folder or a rigged file. A folder that is a subject itself counts, too."""
    folder = _folder(request)
    if _skeleton_files(folder):
        return {folder.absolute().name: folder}
    files = {path.stem: path for path in _files(folder, RIG_SUFFIXES)}
    folders = {path.name: path for path in _subfolders(folder) if not _what_is_missing(path)}
    for name in files.keys() & folders.keys():
        raise UserError(f"{folder} has both {files[name].name} and a folder {name}; rename one of them")
    return dict(sorted((files | folders).items()))


def _find(subject: str, request: DataRequest) -> Path:
    places = _places(request)
    if subject in places:
        return places[subject]
    folder = _folder(request)
    there = next((path for path in _subfolders(folder) if path.name == subject), None)
    if there is not None:
        raise UserError(_what_is_missing(there))
    known = f"; there is {', '.join(list(places)[:8])}" if places else ""
    raise UserError(f"no subject '{subject}' in {folder}{nearest(subject, places) or known}")


def _what_is_missing(folder: Path) -> str:
    """Return why a folder is no subject, empty if it is one."""
    if _skeleton_files(folder) or _files(folder, RIG_SUFFIXES):
        return ""
    inside = [folder, *_subfolders(folder)]
    if any((path / "motion.bvh").is_file() for path in inside):
        return ""
    return f"{folder} has no skeleton: neither skeleton.json, .npz or .bvh, nor a rigged .glb, nor motion.bvh in its sequences"


def _subfolders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def _files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes and path.is_file())


def _skeleton_files(folder: Path) -> list[Path]:
    return [folder / name for name in _SKELETON_FILES if (folder / name).is_file()]


def _rigged_files(place: Path) -> list[Path]:
    """Return the rigged files of a subject; beside a skeleton file they are meshes."""
    if place.is_file():
        return [place]
    return [] if _skeleton_files(place) else _files(place, RIG_SUFFIXES)


def _pose_file(folder: Path) -> Path:
    """Return the pose file of a sequence: one of the usual names, or the only one that it can be."""
    named = [folder / name for name in _POSE_FILES if (folder / name).is_file()]
    others = [path for path in _files(folder, _POSE_SUFFIXES) if path.name not in _NO_POSES]
    if len(named or others) != 1:
        there = f"several: {', '.join(path.name for path in named or others)}" if named or others else "none"
        raise UserError(f"{folder} must hold one pose file ({', '.join(_POSE_FILES)}), there is {there}")
    return (named or others)[0]


# ---------------------------------------------------------------- meshes in files
def _load_meshes(subject: str, folder: Path, config: DataConfig) -> SubjectData:
    sequences = [path for path in _subfolders(folder) if list_surfaces(path) or _files(path, _POSE_SUFFIXES)]
    sequences = sequences or [folder]
    source, skeleton = _read_skeleton(folder, sequences)
    recordings, broken = [], []
    names = folder_names(path.name if path != folder else subject for path in sequences)
    for name, path in zip(names, sequences, strict=True):
        try:
            recordings.append(_read_recording(name, path, skeleton))
        except UserError as error:
            broken.append((name, str(error)))
    if not recordings:
        raise UserError(f"{broken[0][1]} ({len(broken) - 1} more sequences cannot be used)" if broken[1:] else broken[0][1])
    scale, why = person_scale(_first_mesh(recordings), config.scale, skeleton.scale)
    up = config.up if config.up != "auto" else skeleton.up or "y"
    sources = (f"skeleton {source}, {len(skeleton.names)} joints", _world_text(why, up))
    return _subject(subject, skeleton, World(scale, up), recordings, folder, config, sources, broken=tuple(broken))


def _read_skeleton(folder: Path, sequences: list[Path]) -> tuple[Path, SkeletonFile]:
    """Return the skeleton and the file that it is from."""
    files = _skeleton_files(folder)
    if len(files) > 1:
        raise UserError(f"{folder} has two skeletons, {files[0].name} and {files[1].name}; leave one")
    if not files:
        files = [path / "motion.bvh" for path in sequences if (path / "motion.bvh").is_file()][:1]
    path = files[0]
    return path, bvh_skeleton(path) if path.suffix == ".bvh" else read_skeleton(path)


def _read_recording(name: str, folder: Path, skeleton: SkeletonFile) -> Recording:
    path = _pose_file(folder)
    poses = bvh_poses(path, skeleton) if path.suffix.lower() == ".bvh" else read_poses(path, skeleton.order)
    meshes = list_surfaces(folder)
    if len(meshes) != poses.num_frames:
        frames = f"{path.name} has {poses.num_frames} frames"
        raise UserError(f"{folder} has {len(meshes)} meshes, but {frames}; wanted one mesh a frame")
    return Recording(name, poses, FileMeshes(meshes, read_surface, np.eye(4)))


def _first_mesh(recordings: list[Recording]) -> NDArray:
    """Return the vertices of the first mesh that can be read, by which the subject's size is judged."""
    problem = None
    for recording in recordings:
        try:
            vertices, _ = recording.meshes[0]
            if len(vertices) and np.isfinite(vertices).all():
                return vertices
        except UserError as error:
            problem = problem or error
    raise problem or UserError(f"the first meshes of all {len(recordings)} sequences are empty or not finite; repair them")


# ---------------------------------------------------------------- rigged files
def _load_rigged(subject: str, place: Path, paths: list[Path], config: DataConfig) -> SubjectData:
    rigged = read_rigged_files(paths)
    if not rigged.clips:
        raise UserError(f"{place} has no animation; an avatar is learned from motion: export it with its animations")
    skeleton, mesh = rigged.skeleton, rigged.mesh
    scale, why = person_scale(mesh.vertices, config.scale, None)
    up = config.up if config.up != "auto" else "y"  # as the format says
    world = World(scale, up)
    vertices = world.points(mesh.vertices)
    names = folder_names(name for name, _ in rigged.clips)
    recordings = [
        Recording(name, poses, RigMeshes(vertices, mesh.faces, mesh.weights, world.transforms(poses.posed_from_rest)))
        for name, (_, poses) in sorted(zip(names, rigged.clips, strict=True), key=lambda pair: pair[0])
    ]
    files = f"{place}" if len(paths) == 1 else f"{len(paths)} files in {place}"
    sources = [f"rigged file {files}: {len(skeleton.names)} joints, {len(mesh.vertices)} vertices, {len(recordings)} motions"]
    if rigged.dropped:
        some = ", ".join(rigged.dropped[:4]) + (", ..." if len(rigged.dropped) > 4 else "")
        sources.append(f"{len(rigged.dropped)} last joints that move no vertex were left out ({some})")
    sources.append(_world_text(why, up))
    make = partial(_template, vertices, mesh.faces, mesh.weights)
    return _subject(subject, skeleton, world, recordings, place, config, tuple(sources), template=make)


def _template(vertices: NDArray, faces: NDArray, weights: NDArray, skeleton: Skeleton) -> MeshTemplate:
    """Return the mesh in the canonical pose."""
    moved = skeleton.posed_from_rest(skeleton.canonical_pose[None]).numpy()
    canonical, _ = RigMeshes(vertices, faces, weights, moved)[0]
    return MeshTemplate(canonical, faces.astype(np.int32), weights)


# ---------------------------------------------------------------- both
def _subject(
    subject: str,
    skeleton_file: SkeletonFile,
    world: World,
    recordings: list[Recording],
    place: Path,
    config: DataConfig,
    sources: tuple[str, ...],
    *,
    template: Callable[[Skeleton], MeshTemplate] | None = None,
    broken: tuple[tuple[str, str], ...] = (),
) -> SubjectData:
    """Split the recordings and bring everything into the world."""
    skeleton = _world_skeleton(skeleton_file, world, config.canonical)
    test, ood = _patterns(place, config)
    names = sorted([*(recording.name for recording in recordings), *(name for name, _ in broken)])
    if len(names) == 1 and not test:
        recordings = recordings[0].halves()
        splits = {recording.name: "test" if index else "train" for index, recording in enumerate(recordings)}
    else:  # broken ones count, so that mending them changes nothing about the others
        splits = split_sequences(names, test, ood)
    specs = {recording.name: recording.to_sequence(splits[recording.name], skeleton, world) for recording in recordings}
    stretched = [name for name, spec in specs.items() if spec.posed_from_rest is not None]
    if stretched:
        sources += (f"joints stretch, scale or come apart in {', '.join(stretched[:6])}: bone transforms are kept as they are",)
    ordered = sorted(specs.values(), key=lambda spec: SPLITS.index(spec.split))
    made = template(skeleton) if template is not None else None
    return SubjectData("meshes", subject, skeleton, tuple(ordered), made, sources=sources, broken=broken)


def _world_skeleton(file: SkeletonFile, world: World, canonical: str) -> Skeleton:
    rest = torch.from_numpy(world.points(file.joints_rest))
    pose = torch.zeros_like(rest)
    if canonical == "legs_apart":
        if not {"l_hip", "r_hip"} <= set(file.names):
            raise UserError("data.canonical=legs_apart needs joints named l_hip and r_hip, the skeleton has none; give rest")
        pose = legs_apart_pose(file.names, torch.float64)
    elif canonical == "auto" and file.canonical_pose is not None:
        pose = torch.from_numpy(world.angles(file.canonical_pose))
    return Skeleton(file.names, file.parents, rest, pose)


def _patterns(place: Path, config: DataConfig) -> tuple[list[str], list[str]]:
    """Return the patterns of held-out and of out-of-distribution sequences: the user's, else those of `split.json`."""
    path = (place if place.is_dir() else place.parent) / "split.json"
    content = read_json(path, "split") if path.is_file() and place.is_dir() else {}
    if not isinstance(content, dict) or not set(content) <= {"test", "ood", "train"}:
        raise UserError(f'split {path} must be an object such as {{"test": ["walk"], "ood": ["jump*"]}}')
    for name, patterns in content.items():
        if not isinstance(patterns, list) or not all(isinstance(pattern, str) for pattern in patterns):
            raise UserError(f"split {path}: {name} must be a list of names")
    return config.test or content.get("test", []), config.ood or content.get("ood", [])


def _world_text(why: str, up: str) -> str:
    return why + ("" if up == "y" else f"; turned from {up} up")


def _check(config: DataConfig) -> None:
    check_choice("data.up", config.up, ("auto", "y", "z"))
    check_choice("data.canonical", config.canonical, ("auto", "rest", "legs_apart"))
    if config.scale != "auto":
        try:
            scale = float(config.scale)
        except ValueError:
            scale = math.nan
        if not _SCALES[0] <= scale <= _SCALES[1]:
            limits = f"between {_SCALES[0]:g} and {_SCALES[1]:g}"
            raise UserError(f"data.scale must be auto or a number of metres a unit {limits}, got '{config.scale}'")
