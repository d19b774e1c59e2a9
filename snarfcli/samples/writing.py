"""Write processed samples: complete sequences only, and the same settings for all samples of a folder."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from snarfcli.datasets.splits import SPLITS
from snarfcli.errors import UserError
from snarfcli.files import file_digest, flush_to_disk, read_json, remove_temporaries, write_arrays, write_json
from snarfcli.samples.layout import FORMAT_VERSION, SEQUENCE_FILES, check_format
from snarfcli.sampling.points import FrameSamples
from snarfcli.texts import one_line

__all__ = [
    "SequenceWriter",
    "describe_files",
    "discard_samples",
    "remove_leftovers",
    "require_same_settings",
    "settings_digest",
    "write_manifest",
]

_PARTIAL = ".partial"
_SPOOL = "meshes.spool"


def settings_digest(settings: Mapping[str, Any]) -> str:
    """Return a digest of settings that does not depend on their order."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def describe_files(folder: Path, names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return the entries of a manifest for files: size and SHA-256."""
    return {name: {"bytes": (folder / name).stat().st_size, "sha256": file_digest(folder / name)} for name in names}


class SequenceWriter:
    """Writer of one sequence: frames in any order, under a temporary name until the sequence is complete."""

    def __init__(self, folder: Path, num_frames: int, num_points: int) -> None:
        """Create the files of a sequence.

        Args:
            folder: folder of the finished sequence.
            num_frames: number of frames.
            num_points: number of points per frame.

        Raises:
            OSError: the folder cannot be written to.
        """
        self.folder = folder
        self._partial = folder.with_name(f".{folder.name}{_PARTIAL}")
        shutil.rmtree(self._partial, ignore_errors=True)
        self._partial.mkdir(parents=True)
        self._shape = (num_frames, num_points)
        self._cubes = np.zeros((num_frames, 4), np.float32)
        self._boxes = np.zeros((num_frames, 2, 3), np.float32)
        self._inside = self._differing = self._boundary_edges = 0
        # By digest: index, position in the spool, number of faces.
        self._topologies: dict[bytes, tuple[int, int, int]] = {}
        self._topology = np.zeros(num_frames, np.int64)
        # Per frame: position of its vertices in the spool, and their number.
        self._spooled = np.zeros((num_frames, 2), np.int64)
        self._files = contextlib.ExitStack()
        try:
            self._points, self._points_start = self._start_array("points.npy", (*self._shape, 3), "<u2")
            packed = (num_frames, num_points // 8)
            self._occupancies, self._bits_start = self._start_array("occupancies.npy", packed, "|u1")
            self._spool = self._open(_SPOOL, "w+b")
        except BaseException:
            self.discard()
            raise

    def _open(self, name: str, mode: str) -> IO[bytes]:
        """Open a file of the unfinished sequence; `discard` closes it."""
        file = open(self._partial / name, mode)  # noqa: SIM115 - stays open until the sequence is complete
        self._files.callback(_close_quietly, file)
        return file

    def _start_array(self, name: str, shape: tuple[int, ...], dtype: str) -> tuple[IO[bytes], int]:
        """Create a `.npy` file, and return it open with the position of its first value."""
        file = self._open(name, "wb")
        np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
        return file, file.tell()

    def write_frame(self, frame: int, samples: FrameSamples) -> None:
        """Write the points, the labels and the mesh of a frame."""
        num_points = self._shape[1]
        # Plain writes instead of a memory map: a full disk is then an OSError, not a bus error.
        self._points.seek(self._points_start + frame * num_points * 6)
        self._points.write(np.ascontiguousarray(samples.points, "<u2").data)
        self._occupancies.seek(self._bits_start + frame * (num_points // 8))
        self._occupancies.write(np.packbits(samples.occupied).data)
        # The number of vertices of earlier frames may not be known yet, so `finish` puts them in order.
        self._spooled[frame] = self._spool.tell(), len(samples.vertices)
        self._spool.write(np.ascontiguousarray(samples.vertices, "<u8").data)
        self._topology[frame] = self._topology_of(samples.faces)
        self._cubes[frame, :3], self._cubes[frame, 3] = samples.cube_lower, samples.cube_size
        self._boxes[frame] = samples.box_lower, samples.box_upper
        self._inside += int(samples.occupied.sum())
        self._differing += samples.differing
        self._boundary_edges = max(self._boundary_edges, samples.boundary_edges)

    def _topology_of(self, faces: np.ndarray) -> int:
        """Return the index of a list of faces among those written so far; new lists are spooled (scans have one per frame)."""
        content = np.ascontiguousarray(faces, "<i4")
        digest = hashlib.sha256(content.data).digest()
        if digest not in self._topologies:
            self._topologies[digest] = len(self._topologies), self._spool.tell(), len(content)
            self._spool.write(content.data)
        return self._topologies[digest][0]

    def finish(self, arrays: Mapping[str, np.ndarray], description: Mapping[str, Any]) -> dict[str, Any]:
        """Complete the sequence after all frames are written, and return the content of its `sequence.json`.

        Args:
            arrays: [T, ...] each, the arrays of `frames.npz` other than cubes, boxes and starts of meshes.
            description: entries of `sequence.json` other than counts, shares and checksums; must include `settings`.
        """
        self._points.close()
        self._occupancies.close()
        vertex_start = self._write_spooled("vertices.npy", self._spooled, (), "<u8")
        _, first, topology = np.unique(self._topology, return_index=True, return_inverse=True)
        order = np.argsort(first)  # topologies in order of first use
        places = np.array([place for _, *place in self._topologies.values()])
        face_start = self._write_spooled("faces.npy", places[order], (3,), "<i4")
        self._spool.close()
        (self._partial / _SPOOL).unlink()
        meshes = {"vertex_start": vertex_start, "face_start": face_start, "topology": np.argsort(order)[topology]}
        cubes = {"cube_lower": self._cubes[:, :3], "cube_size": self._cubes[:, 3]}
        boxes = {"box_lower": self._boxes[:, 0], "box_upper": self._boxes[:, 1]}
        write_arrays(self._partial / "frames.npz", {**arrays, **cubes, **boxes, **meshes})
        frames, num_points = self._shape
        complete = {
            "format_version": FORMAT_VERSION,
            **description,
            "settings_digest": settings_digest(description["settings"]),
            "frames": frames,
            "points_per_frame": num_points,
            "inside_share": self._inside / (frames * num_points),
            "self_intersecting_share": self._differing / (frames * num_points),
            "boundary_edges": self._boundary_edges,
            "files": describe_files(self._partial, SEQUENCE_FILES),
        }
        for name in SEQUENCE_FILES:
            flush_to_disk(self._partial / name)
        write_json(self._partial / "sequence.json", complete)
        if self.folder.exists():
            shutil.rmtree(self.folder)
        os.replace(self._partial, self.folder)
        flush_to_disk(self.folder.parent)
        return complete

    def _write_spooled(self, name: str, places: np.ndarray, row: tuple[int, ...], dtype: str) -> np.ndarray:
        """Write parts of the spool, given by position and number of rows, as one array; return their starts, and the end."""
        starts = np.concatenate([[0], np.cumsum(places[:, 1])])
        file, _ = self._start_array(name, (int(starts[-1]), *row), dtype)
        size = np.dtype(dtype).itemsize * math.prod(row)
        with file:
            for place, count in places:
                self._spool.seek(int(place))
                file.write(self._spool.read(int(count) * size))
        return starts

    def discard(self) -> None:
        """Delete the files of an unfinished sequence; has no effect after `finish`."""
        self._files.close()
        shutil.rmtree(self._partial, ignore_errors=True)


def _close_quietly(file: IO[bytes]) -> None:
    with contextlib.suppress(OSError):  # a full disk raises again when the buffer is flushed
        file.close()


def require_same_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """Check that the samples in a folder were made with the same settings.

    Raises:
        UserError: they were not; the message names each setting that differs, or the format version.
    """
    for path in [folder / "manifest.json", *sorted(folder.glob("*/*/sequence.json"))]:
        if not path.exists():
            continue
        there = read_json(path, "samples")
        check_format(there, folder)
        before = there.get("settings")
        before = before if isinstance(before, dict) else {}
        names = [name for name in {**settings, **before} if settings.get(name) != before.get(name)]
        if names:
            changes = ", ".join(
                f"{name} {str(before.get(name, 'unset'))[:60]} -> {settings.get(name, 'unset')}" for name in names[:9]
            )
            raise UserError(
                f"the samples in {folder} were made with other settings ({one_line(changes, 400)}); "
                "keep those settings, or start again with overwrite=true"
            )


def discard_samples(folder: Path) -> None:
    """Delete the samples in the folder of a subject; other files are kept."""
    for name in ("manifest.json", "subject.npz"):  # the manifest first, since the store does not exist without it
        (folder / name).unlink(missing_ok=True)
    for split in SPLITS:
        if (folder / split).is_dir():
            shutil.rmtree(folder / split)


def remove_leftovers(folder: Path) -> None:
    """Delete incomplete files of an interrupted run: partial sequences, a subject without sequences, empty folders."""
    remove_temporaries(folder)
    for partial in folder.glob(f"*/.*{_PARTIAL}"):
        shutil.rmtree(partial, ignore_errors=True)
    if not any(folder.glob("*/*/sequence.json")):
        with contextlib.suppress(OSError):
            (folder / "subject.npz").unlink(missing_ok=True)
    for empty in (*(folder / split for split in SPLITS), folder):
        with contextlib.suppress(OSError):
            empty.rmdir()


def write_manifest(folder: Path, header: Mapping[str, Any], sequences: list[dict[str, Any]]) -> dict[str, Any]:
    """Write the manifest of a subject, which completes its samples, and return it.

    Args:
        folder: folder of the subject, with `subject.npz`.
        header: first entries: `data`, `subject`, `settings` and the origin of the samples.
        sequences: content of `sequence.json` of each sequence, in the order of the data set.
    """
    total = sum(entry["frames"] * entry["points_per_frame"] for entry in sequences)

    def share(name: str) -> float:
        weighted = (entry[name] * entry["frames"] * entry["points_per_frame"] for entry in sequences)
        return sum(weighted) / total if total else 0.0

    files = describe_files(folder, ("subject.npz",))
    sizes = [entry["bytes"] for described in (files, *(s["files"] for s in sequences)) for entry in described.values()]
    manifest = {
        "format_version": FORMAT_VERSION,
        **header,
        "settings_digest": settings_digest(header["settings"]),
        "frames": {split: sum(s["frames"] for s in sequences if s["split"] == split) for split in SPLITS},
        "points": total,
        "bytes": sum(sizes),
        "inside_share": share("inside_share"),
        "self_intersecting_share": share("self_intersecting_share"),
        "files": files,
        "sequences": [
            {key: value for key, value in entry.items() if key not in ("settings", "settings_digest", "format_version")}
            for entry in sequences
        ],
    }
    write_json(folder / "manifest.json", manifest)
    return manifest
