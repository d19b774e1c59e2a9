"""What of a subject's samples is there already, and what a sequence's samples are made from."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from snarfcli.bodies import Skeleton, invert_rigid
from snarfcli.datasets.subjects import SequenceSpec, SubjectData
from snarfcli.errors import UserError
from snarfcli.files import read_json, read_npz
from snarfcli.samples.store import SEQUENCE_FILES
from snarfcli.samples.writing import settings_digest, write_arrays
from snarfcli.sampling import check_mesh

__all__ = ["complete_sequences", "frame_arrays", "frame_numbers", "write_subject"]

log = logging.getLogger(__name__)

_POSE_TOLERANCE = 1e-4  # radians and metres; the same motion on another machine differs by rounding only
_ANEW = "delete it to make it anew, or give overwrite=true"


def write_subject(folder: Path, subject: SubjectData, inside_test: str) -> None:
    """Write `subject.npz`, or check that the one there is of the same subject."""
    skeleton, template = subject.skeleton, subject.template
    arrays = {
        "names": np.array(skeleton.names),
        "parents": np.array(skeleton.parents, np.int32),
        "joints_rest": skeleton.joints_rest.numpy().astype(np.float32),
        "canonical_pose": skeleton.canonical_pose.numpy().astype(np.float32),
        "betas": np.asarray(subject.betas, np.float32),
    }
    if template is not None:
        boundary_edges = check_mesh(template.vertices, template.faces, inside_test, f"the mesh of subject {subject.subject}")
        if boundary_edges:
            log.warning(
                "the mesh of subject %s is open, %d boundary edges: labelled by winding number, inside is above a half",
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
        same = name in arrays and name in there and there[name].shape == arrays[name].shape
        if same and arrays[name].dtype.kind == "f":
            same = np.allclose(there[name], arrays[name], rtol=0.0, atol=_POSE_TOLERANCE)
        elif same:
            same = np.array_equal(there[name], arrays[name])
        if not same:
            raise UserError(
                f"the samples in {folder} were made from another body ({name} differs); start again with overwrite=true"
            )


def complete_sequences(
    folder: Path, subject: SubjectData, settings: Mapping[str, Any], frame_steps: Mapping[str, int]
) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the descriptions of the sequences that need not be made again, by split and name."""
    done = {}
    for spec in subject.sequences:
        place = folder / spec.split / spec.name
        if not (place / "sequence.json").exists():
            continue
        try:
            entry = read_json(place / "sequence.json", "samples")
            sizes = {name: entry["files"][name]["bytes"] for name in SEQUENCE_FILES}
            is_whole = entry["settings_digest"] == settings_digest(settings)
            is_whole &= all((place / name).is_file() and (place / name).stat().st_size == size for name, size in sizes.items())
            there = read_npz(place / "frames.npz", "samples") if is_whole else {}
        except (UserError, KeyError, TypeError):
            is_whole = False
        frames = frame_numbers(spec, frame_steps)
        wanted = frame_arrays(subject.skeleton, spec, frames)
        if not is_whole or not wanted.keys() <= there.keys():
            log.warning("%s/%s is damaged and is made again", spec.split, spec.name)
            continue
        differs = [
            name
            for name, array in wanted.items()
            if there[name].shape != array.shape or not np.allclose(there[name], array, rtol=0.0, atol=_POSE_TOLERANCE)
        ]
        if not differs and entry.get("source") != spec.meshes.fingerprint():
            raise UserError(f"{place} was made from other meshes (the files have changed); {_ANEW}")
        if differs:
            raise UserError(f"{place} was made from another motion ({differs[0]} differs); {_ANEW}")
        done[spec.split, spec.name] = entry
    return done


def frame_numbers(spec: SequenceSpec, frame_steps: Mapping[str, int]) -> np.ndarray:
    """Return the numbers of the frames to sample."""
    if spec.frames is not None:
        return np.asarray(spec.frames, np.int64)
    return np.arange(0, spec.motion.num_frames, frame_steps[spec.split])


def frame_arrays(skeleton: Skeleton, spec: SequenceSpec, frames: np.ndarray) -> dict[str, np.ndarray]:
    """Return what `frames.npz` says about the chosen frames: float32, metres and radians."""
    skeleton = skeleton.to(torch.float64)
    pose = torch.from_numpy(spec.motion.poses[frames])
    translation = torch.from_numpy(spec.motion.translation[frames])
    if spec.posed_from_rest is None:
        posed_from_rest = skeleton.posed_from_rest(pose, translation)
    else:
        posed_from_rest = torch.from_numpy(spec.posed_from_rest[frames])
    canonical_from_rest = skeleton.posed_from_rest(skeleton.canonical_pose[None])
    joints = torch.einsum("tjrc,jc->tjr", posed_from_rest[..., :3, :3], skeleton.joints_rest) + posed_from_rest[..., :3, 3]
    arrays = {
        "poses": pose,
        "translation": translation,
        "posed_from_canonical": posed_from_rest @ invert_rigid(canonical_from_rest),
        "joints": joints,
    }
    for name, array in arrays.items():
        bad = np.flatnonzero(~array.isfinite().flatten(1).all(1).numpy())
        if len(bad):
            raise UserError(f"{spec.name} has NaN or infinite {name} in frame {frames[bad[0]]}; repair its poses first")
    return {name: array.numpy().astype(np.float32) for name, array in arrays.items()} | {"frame_numbers": frames}
