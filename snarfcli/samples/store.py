"""The store of processed samples: memory-mapped points and labels, poses and meshes of one subject.

A subject's folder `{root}/processed/{data}/{subject}` holds

    manifest.json                      what made it, settings, versions, counts, checksums; written last
    subject.npz                        skeleton; mesh in the canonical pose, where the data set has one
    {train,test,ood}/{sequence}/
        points.npy       [T, P, 3]     uint16, quantised in the frame's sampling cube
        occupancies.npy  [T, P / 8]    uint8, one bit a point, most significant first
        vertices.npy     [sum V]       uint64, the posed meshes' vertices, 21 bits an axis, one frame after the other
        faces.npy        [sum F, 3]    int32, the faces of each topology that occurs
        frames.npz                     poses, bone transforms, joints, cubes, boxes, where each mesh starts
        sequence.json                  settings, counts, checksums; a sequence without it does not exist
"""

from __future__ import annotations

import zipfile
import zlib
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from snarfcli.errors import UserError, nearest
from snarfcli.files import file_digest, read_json
from snarfcli.sampling.cube import dequantise, unpack_vertices

if TYPE_CHECKING:
    from snarfcli.bodies.skeleton import Skeleton
    from snarfcli.bodies.template import MeshTemplate

__all__ = [
    "FORMAT_VERSION",
    "SEQUENCE_FILES",
    "SPLITS",
    "SampleStore",
    "SequenceSamples",
    "check_format",
    "samples_folder",
]

FORMAT_VERSION = 2
"""Rises whenever older samples could be misread."""

SPLITS = ("train", "test", "ood")
"""Training motion, held-out motion of the same kind, out-of-distribution motion."""

SEQUENCE_FILES = ("points.npy", "occupancies.npy", "vertices.npy", "faces.npy", "frames.npz")
"""The files of a sequence besides its description."""

_VALIDATION_SHARE = 0.1
_ADVICE = {
    "train": "preprocess training sequences, or name data that has some (poseprior has none)",
    "test": "evaluate out of distribution (--ood), or preprocess held-out sequences (data.test=[NAME])",
    "ood": "leave out --ood, or preprocess out-of-distribution sequences (data.ood=[NAME]; PosePrior for dfaust)",
}


def samples_folder(root: str | Path, data: str, subject: str) -> Path:
    """Return where the samples of one subject live."""
    return Path(root) / "processed" / data / subject


class SequenceSamples:
    """The samples of one sequence: T frames of P points. Points and labels stay on disk until they are asked for."""

    def __init__(self, folder: Path, description: dict[str, Any]) -> None:
        """Open the sequence in `folder` as its `sequence.json` describes it.

        Raises:
            UserError: a file is missing, or has another size than was written.
        """
        self.folder = folder
        self.description = description
        self.name: str = description["name"]
        self.split: str = description["split"]
        self.num_frames: int = description["frames"]
        self.num_points: int = description["points_per_frame"]
        _check_sizes(folder, description["files"])
        self._cells = _open_array(folder / "points.npy", (self.num_frames, self.num_points, 3), np.uint16)
        self._packed = _open_array(folder / "occupancies.npy", (self.num_frames, self.num_points // 8), np.uint8)
        arrays = _read_arrays(folder / "frames.npz")
        self._vertex_start, self._face_start = arrays["vertex_start"], arrays["face_start"]
        self._topology = arrays["topology"]
        self.poses: np.ndarray = arrays["poses"]
        """[T, J, 3], float32 axis-angle, radians, global orientation included."""
        self.translation: np.ndarray = arrays["translation"]
        """[T, 3], float32 metres; already part of the bone transforms."""
        self.bone_transforms: np.ndarray = arrays["posed_from_canonical"]
        """[T, J, 4, 4], float32, canonical to posed, metres."""
        self.joints: np.ndarray = arrays["joints"]
        """[T, J, 3], float32 posed joints, metres."""
        self.frame_numbers: np.ndarray = arrays["frame_numbers"]
        """[T], int64, numbers of the frames within the motion."""
        self.frame_rate: float = description["frame_rate"]
        """Frames of the motion a second; the samples may leave some out."""
        self._cube_lower, self._cube_size = arrays["cube_lower"], arrays["cube_size"]
        self._box_lower, self._box_upper = arrays["box_lower"], arrays["box_upper"]

    # Opened when they are asked for: every open array takes one of the files that a process may have open.
    @cached_property
    def _vertices(self) -> np.ndarray:
        return _open_array(self.folder / "vertices.npy", (int(self._vertex_start[-1]),), np.uint64)

    @cached_property
    def _faces(self) -> np.ndarray:
        return _open_array(self.folder / "faces.npy", (int(self._face_start[-1]), 3), np.int32)

    @property
    def num_uniform(self) -> int:
        """How many of the P points are uniform in the cube: the first half. The rest are near the surface."""
        return self.num_points // 2

    @property
    def train_frames(self) -> np.ndarray:
        """Frames to train on: all but the last tenth of a training sequence, none of another."""
        return np.arange(self.num_frames - self._num_validation if self.split == "train" else 0)

    @property
    def val_frames(self) -> np.ndarray:
        """Frames to validate on: the last tenth of a training sequence, none of another."""
        last = self.num_frames if self.split == "train" else 0
        return np.arange(max(0, last - self._num_validation), last)

    @property
    def _num_validation(self) -> int:
        return min(self.num_frames - 1, max(1, round(self.num_frames * _VALIDATION_SHARE)))

    def points(self, frames: int | np.ndarray, index: np.ndarray | None = None) -> np.ndarray:
        """Return posed points, metres; only the chosen ones are read from disk.

        Args:
            frames: a frame, or [B] frames.
            index: numbers of the wanted points, all if None: [N] the same in each frame, or [B, N].

        Returns:
            [..., N, 3] float32, led by the shape of `frames`.
        """
        frames, rows = _rows(frames, index)
        cells = self._cells[frames] if index is None else self._cells[rows, index]
        return dequantise(cells, self._cube_lower[frames][..., None, :], self._cube_size[frames][..., None, None])

    def occupancies(self, frames: int | np.ndarray, index: np.ndarray | None = None) -> np.ndarray:
        """Return the labels of the points that `points` returns: [..., N] bool, True inside."""
        frames, rows = _rows(frames, index)
        if index is None:
            return np.unpackbits(self._packed[frames], axis=-1).view(bool)
        index = np.asarray(index)
        return ((self._packed[rows, index >> 3] >> (7 - (index & 7)).astype(np.uint8)) & 1).view(bool)

    def vertices(self, frame: int) -> np.ndarray:
        """Return the posed mesh of one frame: [V, 3] float32, metres, right to a micrometre."""
        cells = self._vertices[self._vertex_start[frame] : self._vertex_start[frame + 1]]
        return unpack_vertices(cells, self._cube_lower[frame], self._cube_size[frame])

    def faces(self, frame: int) -> np.ndarray:
        """Return the faces of one frame's mesh: [F, 3] int32, outward."""
        topology = self._topology[frame]
        return np.array(self._faces[self._face_start[topology] : self._face_start[topology + 1]])

    def box(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the tight box of one frame's posed mesh: lower [3] and upper [3], float32, metres."""
        return self._box_lower[frame], self._box_upper[frame]

    def cube(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the papers' box of one frame, in which all its points lie: lower [3] and upper [3], float32, metres."""
        return self._cube_lower[frame], self._cube_lower[frame] + self._cube_size[frame]

    def verify(self) -> None:
        """Compare every file with the checksum that was written beside it.

        Raises:
            UserError: one differs.
        """
        for name, entry in self.description["files"].items():
            if file_digest(self.folder / name) != entry["sha256"]:
                raise UserError(f"{self.folder / name} is damaged (its checksum differs); {_again(self.folder)}")


class SampleStore:
    """All processed samples of one subject."""

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        """Open the store in `folder`; use `open`, which checks that there is one."""
        # here, since both need PyTorch: worker processes that only read sequences start in a fifth of the time without it
        from snarfcli.bodies.skeleton import Skeleton
        from snarfcli.bodies.template import MeshTemplate

        self.folder = folder
        self.manifest = manifest
        self.data: str = manifest["data"]
        self.subject: str = manifest["subject"]
        _check_sizes(folder, manifest["files"])
        arrays = _read_arrays(folder / "subject.npz")
        self.skeleton: Skeleton = Skeleton.from_dict(arrays)
        self.template: MeshTemplate | None = None
        """The subject's mesh in the canonical pose, where the data set has one; float32."""
        if "vertices_canonical" in arrays:
            self.template = MeshTemplate(arrays["vertices_canonical"], arrays["faces"], arrays["vertex_weights"])
        self.betas: np.ndarray = arrays["betas"]
        """[S], float32 shape parameters of the body model; none without one."""
        self._sequences = [SequenceSamples(folder / entry["split"] / entry["name"], entry) for entry in manifest["sequences"]]

    @classmethod
    def open(cls, root: str | Path, data: str, subject: str) -> SampleStore:
        """Open the samples of one subject.

        Args:
            root: the data folder; the samples are under `processed/{data}/{subject}`.
            data: name of the data set, such as `builtin`.
            subject: name of the subject.

        Raises:
            UserError: there are none, they are unfinished, damaged, or of another format version; the message says what
                to do.
        """
        folder = samples_folder(root, data, subject)
        elsewhere = "" if str(root) == "data" else f" data_root={root}"
        command = f'run "snarf preprocess data={data} subject={subject}{elsewhere}"'
        if not (folder / "manifest.json").exists():
            if any(folder.glob("*/*/sequence.json")):
                begun = f"the samples of subject {subject} under {folder} are unfinished"
                raise UserError(f"{begun}; {command}, with the settings it began with, to go on")
            raise UserError(f"no samples of subject {subject} under {folder.parent}; {command}")
        manifest = read_json(folder / "manifest.json", "manifest of the samples")
        check_format(manifest, folder)
        try:
            return cls(folder, manifest)
        except (KeyError, TypeError) as error:
            raise UserError(f"the samples are damaged: {folder} lacks {error} or has it otherwise; {_again(folder)}") from None

    @property
    def all_sequences(self) -> list[SequenceSamples]:
        """The sequences of all splits, in the order of the data set."""
        return list(self._sequences)

    def sequences(self, split: str) -> list[SequenceSamples]:
        """Return the sequences of one split, in the order of the data set.

        Raises:
            ValueError: `split` is not one of `SPLITS`.
            UserError: the store has no sequence of this split.
        """
        if split not in SPLITS:
            raise ValueError(f"split: wanted one of {', '.join(SPLITS)}, got {split!r}{nearest(split, SPLITS)}")
        chosen = [sequence for sequence in self._sequences if sequence.split == split]
        if not chosen:
            there = ", ".join(dict.fromkeys(sequence.split for sequence in self._sequences))
            have = f"the samples in {self.folder} have no sequence of split {split}, only of {there}"
            raise UserError(f"{have}; {_ADVICE[split]}")
        return chosen

    def verify(self) -> None:
        """Compare every file with its checksum, which reads them all.

        Raises:
            UserError: one differs.
        """
        for name, entry in self.manifest["files"].items():
            if file_digest(self.folder / name) != entry["sha256"]:
                raise UserError(f"{self.folder / name} is damaged (its checksum differs); {_again(self.folder)}")
        for sequence in self._sequences:
            sequence.verify()


def check_format(description: Any, folder: Path) -> None:
    """Refuse a manifest or sequence description of another format version.

    Raises:
        UserError: it is older or newer, or is no description at all.
    """
    version = description.get("format_version") if isinstance(description, dict) else None
    if version != FORMAT_VERSION:
        age = "an older" if isinstance(version, int) and version < FORMAT_VERSION else "another"
        raise UserError(
            f"the samples in {folder} have {age} format (version {version}, wanted {FORMAT_VERSION}); "
            'make them again: "snarf preprocess ... overwrite=true"'
        )


def _again(folder: Path) -> str:
    return f'delete {folder} or run "snarf preprocess" again with overwrite=true'


def _rows(frames: int | np.ndarray, index: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return `frames` as an array, and once more with an axis for the points of each."""
    frames = np.asarray(frames)
    return frames, frames[..., None] if index is not None else frames


def _check_sizes(folder: Path, files: dict[str, dict[str, Any]]) -> None:
    for name, entry in files.items():
        path = folder / name
        size = path.stat().st_size if path.exists() else None
        if size != entry["bytes"]:
            came = "is missing" if size is None else f"has {size} bytes, {entry['bytes']} were written"
            raise UserError(f"the samples are damaged: {path} {came}; {_again(folder)}")


def _open_array(path: Path, shape: tuple[int, ...], dtype: type) -> np.ndarray:
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise UserError(f"the samples are damaged: {path} cannot be read ({error}); {_again(path.parent)}") from None
    if array.shape != shape or array.dtype != dtype:
        raise UserError(
            f"the samples are damaged: {path} holds {array.dtype} {list(array.shape)}, "
            f"wanted {np.dtype(dtype)} {list(shape)}; {_again(path.parent)}"
        )
    return array


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read an archive of ours."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}
    except (ValueError, EOFError, OSError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"the samples are damaged: {path} cannot be read ({error}); {_again(path.parent)}") from None
