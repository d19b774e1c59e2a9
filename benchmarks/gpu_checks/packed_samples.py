"""Copies of samples without the meshes that training does not read, which are half of their size."""

from __future__ import annotations

import shutil
from pathlib import Path
from unittest import mock

import numpy as np

from snarfcli.files import file_digest, read_json, write_arrays, write_json
from snarfcli.samples.sequence import SequenceSamples
from snarfcli.samples.store import SampleStore
from snarfcli.training.rough_shape import rough_canonical_points

__all__ = ["copy_samples", "frames_with_meshes"]


def copy_samples(source: Path, target: Path, subject: str) -> None:
    """Copy the samples of a built-in subject from one data folder to another.

    In the copy all frames have points and labels, and only those whose mesh a new avatar is made from have vertices; none has
    faces. So it trains and evaluates as the original does, without fresh points and surface metrics.
    """
    place = Path("processed") / "builtin" / subject
    shutil.copytree(source / place, target / place, dirs_exist_ok=True, ignore=shutil.ignore_patterns("manifest.json"))
    manifest = read_json(source / place / "manifest.json", "manifest of the samples")
    needed = frames_with_meshes(SampleStore.open(source, "builtin", subject))
    for sequence in manifest["sequences"]:
        folder = target / place / sequence["split"] / sequence["name"]
        frames = needed.get(sequence["name"], set()) if sequence["split"] == "train" else set()
        description = read_json(folder / "sequence.json", "description of a sequence")
        for name in _drop_meshes(folder, frames):
            entry = {"bytes": (folder / name).stat().st_size, "sha256": file_digest(folder / name)}
            sequence["files"][name] = description["files"][name] = entry
        write_json(folder / "sequence.json", description)
    write_json(target / place / "manifest.json", manifest)  # last: it says that all is there


def frames_with_meshes(store: SampleStore) -> dict[str, set[int]]:
    """Return the training frames whose meshes a new avatar is made from, by sequence."""
    read: dict[str, set[int]] = {}
    original = SequenceSamples.vertices

    def vertices(sequence: SequenceSamples, frame: int) -> np.ndarray:
        read.setdefault(sequence.name, set()).add(frame)
        return original(sequence, frame)

    with mock.patch.object(SequenceSamples, "vertices", vertices):
        rough_canonical_points(store)
    return read


def _drop_meshes(folder: Path, kept: set[int]) -> list[str]:
    """Drop the faces of a sequence, and the vertices of all frames but some; return the names of the changed files."""
    with np.load(folder / "frames.npz") as file:
        arrays = dict(file)
    cells, starts = np.load(folder / "vertices.npy"), arrays["vertex_start"]
    counts = np.where(np.isin(np.arange(len(starts) - 1), list(kept)), np.diff(starts), 0)
    np.save(folder / "vertices.npy", np.concatenate([cells[:0], *(cells[starts[f] : starts[f + 1]] for f in sorted(kept))]))
    np.save(folder / "faces.npy", np.zeros((0, 3), np.int32))
    arrays["vertex_start"] = np.concatenate([[0], np.cumsum(counts)])
    arrays["face_start"] = np.zeros_like(arrays["face_start"])
    write_arrays(folder / "frames.npz", arrays)
    return ["vertices.npy", "faces.npy", "frames.npz"]
