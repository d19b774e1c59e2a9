"""Find the files of subjects with posed meshes; `meshes.py` describes the folders."""

from __future__ import annotations

import shlex
from pathlib import Path

from snarfcli.datasets.rigged import RIG_SUFFIXES
from snarfcli.datasets.sources import Request
from snarfcli.errors import UserError, nearest
from snarfcli.point_clouds import list_frames

__all__ = [
    "POSE_FILES",
    "POSE_SUFFIXES",
    "WANTED",
    "files_with",
    "find_subject",
    "frame_files",
    "meshes_folder",
    "missing_parts",
    "pose_file",
    "rigged_files",
    "skeleton_files",
    "subfolders",
    "subject_places",
]

POSE_FILES = ("poses.npz", "poses.json", "motion.bvh")
"""Usual names of pose files."""
POSE_SUFFIXES = (".npz", ".json", ".bvh")
"""Suffixes of pose files."""
WANTED = "a rigged <subject>.glb, or <subject>/ with skeleton.json and one folder of meshes and poses per sequence"
"""What a folder of subjects must have, for messages."""
_SKELETON_FILES = ("skeleton.json", "skeleton.npz", "skeleton.bvh")
_NO_POSES = ("split.json", *_SKELETON_FILES)


def meshes_folder(request: Request, wanted: str = WANTED) -> Path:
    """Return the folder of the subjects; `wanted` says what it must have, for messages.

    Raises:
        UserError: it does not exist.
    """
    folder = request.folder if request.config.folder is not None else request.data_root / "meshes"
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "does not exist"
        raise UserError(f"the folder of meshes {folder} {problem}; give data.folder=FOLDER with {wanted}")
    return folder


def subject_places(request: Request) -> dict[str, Path]:
    """Return the folder or rigged file of each subject by name; the request may also name the folder of one subject.

    Raises:
        UserError: there is no folder, or a subject has two rigged files, or both a folder and a rigged file.
    """
    folder = meshes_folder(request)
    if skeleton_files(folder):
        return {folder.absolute().name: folder}
    files: dict[str, Path] = {}
    for path in files_with(folder, RIG_SUFFIXES):
        other = files.setdefault(path.stem, path)
        if other != path:
            raise UserError(f"{folder} has both {other.name} and {path.name}; rename one of them")
    folders = {path.name: path for path in subfolders(folder) if not missing_parts(path)}
    for name in files.keys() & folders.keys():
        raise UserError(f"{folder} has both {files[name].name} and a folder {name}; rename one of them")
    return dict(sorted((files | folders).items()))


def find_subject(subject: str, request: Request) -> Path:
    """Return the folder or rigged file of a subject.

    Raises:
        UserError: it does not exist, lacks a skeleton, or is given as a file.
    """
    _check_name(subject, request)
    places = subject_places(request)
    if subject in places:
        return places[subject]
    folder = meshes_folder(request)
    there = next((path for path in subfolders(folder) if path.name == subject), None)
    if there is not None:
        raise UserError(missing_parts(there))
    known = f"; wanted one of {', '.join(list(places)[:8])}" if places else ""
    raise UserError(f"no subject '{subject}' in {folder}{nearest(subject, places) or known}")


def _check_name(subject: str, request: Request) -> None:
    """Raise UserError for a subject that is given as the path of a rigged file, and not by its name."""
    path = Path(subject)
    if path.suffix.lower() not in RIG_SUFFIXES:
        return
    usual = (request.folder if request.config.folder is not None else request.data_root / "meshes") / path.name
    if path.parent != Path():
        settings = shlex.join([f"data.folder={path.parent}", f"subject={path.stem}"])
    elif usual.is_file():
        settings = shlex.quote(f"subject={path.stem}")
    else:
        return
    raise UserError(f"subject: wanted the name of a subject, got the file {subject}; give {settings}")


def missing_parts(folder: Path) -> str:
    """Return what a folder lacks to be a subject, for messages; empty if it is one."""
    if skeleton_files(folder) or files_with(folder, RIG_SUFFIXES):
        return ""
    inside = [folder, *subfolders(folder)]
    if any((path / "motion.bvh").is_file() for path in inside):
        return ""
    missing = f"{folder} has no skeleton: wanted skeleton.json, .npz or .bvh, a rigged .glb, or motion.bvh in its sequences"
    fits = f'; for scans of a person, "snarf fit data=meshes subject={folder.name}" makes skeleton and poses'
    return missing + (fits if any(map(frame_files, inside)) else "")


def subfolders(folder: Path) -> list[Path]:
    """Return the folders in a folder, sorted by name, without hidden ones."""
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def files_with(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Return the files in a folder that have one of some suffixes, sorted by name."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes and path.is_file())


def frame_files(folder: Path) -> list[Path]:
    """Return the files of the frames of a sequence, meshes or points, in natural order, without its poses and skeleton."""
    return list_frames(folder, {*POSE_FILES, *_NO_POSES})


def skeleton_files(folder: Path) -> list[Path]:
    """Return the skeleton files in a folder."""
    return [folder / name for name in _SKELETON_FILES if (folder / name).is_file()]


def rigged_files(place: Path) -> list[Path]:
    """Return the rigged files of a subject; beside a skeleton file, glTF files are meshes and do not count."""
    if place.is_file():
        return [place]
    return [] if skeleton_files(place) else files_with(place, RIG_SUFFIXES)


def pose_file(folder: Path) -> Path:
    """Return the pose file of a sequence: one of the usual names, or the only file with a suffix of pose files.

    Raises:
        UserError: there is none, or several.
    """
    named = [folder / name for name in POSE_FILES if (folder / name).is_file()]
    others = [path for path in files_with(folder, POSE_SUFFIXES) if path.name not in _NO_POSES]
    if len(named or others) != 1:
        got = ", ".join(path.name for path in named or others) or "none"
        raise UserError(f"{folder}: wanted one pose file ({', '.join(POSE_FILES)}), got {got}; add or remove files")
    return (named or others)[0]
