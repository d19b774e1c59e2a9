"""Detect the finished sequences of a subject, and check that they were made from the same data."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.array_files import read_npz
from snarfcli.datasets.subjects import SubjectData
from snarfcli.errors import UserError
from snarfcli.files import read_json, write_arrays
from snarfcli.samples.frames import frame_arrays, frame_numbers
from snarfcli.samples.layout import SEQUENCE_FILES
from snarfcli.samples.manifests import is_sequence
from snarfcli.samples.writing import settings_digest
from snarfcli.sampling import check_mesh

__all__ = ["complete_sequences", "write_subject"]

log = logging.getLogger(__name__)

_POSE_TOLERANCE = 1e-4  # radians and metres; on another machine the same motion differs only by rounding
_ADVICE = "delete it to make it again, or give overwrite=true"


def write_subject(folder: Path, subject: SubjectData, inside_test: str) -> None:
    """Write `subject.npz`; if it exists, check that it describes the same subject.

    Args:
        folder: folder of the subject's samples.
        subject: the subject.
        inside_test: the inside test of the samples; some require a closed mesh.

    Raises:
        UserError: the file that exists is damaged or differs, or the mesh of the subject cannot be used.
    """
    skeleton, template = subject.skeleton, subject.template
    arrays = {
        "names": np.array(skeleton.names),
        "parents": np.array(skeleton.parents, np.int32),
        "joints_rest": skeleton.joints_rest.numpy().astype(np.float32),
        "canonical_pose": skeleton.canonical_pose.numpy().astype(np.float32),
        "betas": np.asarray(subject.betas, np.float32),
    }
    if skeleton.idle:
        arrays["idle"] = np.array(skeleton.idle, np.int32)
    if template is not None:
        boundary_edges = check_mesh(template.vertices, template.faces, inside_test, f"the mesh of subject {subject.subject}")
        if boundary_edges:
            log.warning(
                "the mesh of subject %s is open, %d boundary edges: labelled by winding number, inside is above 0.5",
                subject.subject, boundary_edges,
            )  # fmt: skip
        arrays |= {
            "faces": template.faces.astype(np.int32),
            "vertices_canonical": template.vertices.astype(np.float32),
            "vertex_weights": template.weights.astype(np.float32),
        }
    path = folder / "subject.npz"
    if not path.exists():
        write_arrays(path, arrays)
        return
    try:
        there = read_npz(path, "samples")
    except UserError:
        raise UserError(f"the samples are damaged: {path} cannot be read; start again with overwrite=true") from None
    for name in sorted(arrays.keys() | there.keys()):
        if name not in arrays or name not in there or not _is_close(there[name], arrays[name]):
            raise UserError(
                f"the samples in {folder} were made from another body ({name} differs); start again with overwrite=true"
            )


def complete_sequences(
    folder: Path, subject: SubjectData, settings: Mapping[str, Any], frame_steps: Mapping[str, int]
) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the descriptions of the finished sequences by split and name; damaged ones are left out.

    Args:
        folder: folder of the subject's samples.
        subject: the subject.
        settings: settings of the samples.
        frame_steps: per split, the step between sampled frames.

    Raises:
        UserError: a sequence was made from another motion or from other meshes.
    """
    done = {}
    for spec in subject.sequences:
        place = folder / spec.split / spec.name
        if not (place / "sequence.json").exists():
            continue
        entry, there = {}, {}
        is_whole = False
        with contextlib.suppress(UserError):  # damaged; errors of the system end the command
            entry = read_json(place / "sequence.json", "samples")
            is_whole = is_sequence(entry) and entry.get("settings_digest") == settings_digest(settings)
            is_whole = is_whole and all(_has_size(place / name, entry["files"][name]["bytes"]) for name in SEQUENCE_FILES)
            there = read_npz(place / "frames.npz", "samples") if is_whole else {}
        frames = frame_numbers(spec, frame_steps)
        wanted = frame_arrays(subject.skeleton, spec, frames)
        if not is_whole or not wanted.keys() <= there.keys():
            log.warning("%s/%s is damaged and is made again", spec.split, spec.name)
            continue
        differs = [name for name, array in wanted.items() if not _is_close(there[name], array)]
        if not differs and entry.get("source") != spec.meshes.fingerprint():
            raise UserError(f"{place} was made from other meshes (the files have changed); {_ADVICE}")
        if differs:
            raise UserError(f"{place} was made from another motion ({differs[0]} differs); {_ADVICE}")
        done[spec.split, spec.name] = entry
    return done


def _has_size(path: Path, size: int) -> bool:
    return path.is_file() and path.stat().st_size == size


def _is_close(there: np.ndarray, wanted: np.ndarray) -> bool:
    """Return whether an array in a file is the wanted one; numbers may differ by rounding."""
    if there.shape != wanted.shape or there.dtype.kind != wanted.dtype.kind:
        return False
    if wanted.dtype.kind == "f":
        return np.allclose(there, wanted, rtol=0.0, atol=_POSE_TOLERANCE)
    return np.array_equal(there, wanted)
