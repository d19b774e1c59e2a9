"""CAPE: sequences of registered meshes of clothed people, one file per frame, with SMPL's topology.

A subject here is one person in one outfit, such as `00032_longshort`. The layout is that of the archive:

    cape_release/sequences/00032/longshort_hips/*.npz     v_posed (6890, 3), pose (72,), transl (3,)
    cape_release/minimal_body_shape/00032/00032_minimal.npy
    cape_release/misc/subj_genders.pkl
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from snarfcli.array_files import read_npy
from snarfcli.bodies import Body, find_body, load_body
from snarfcli.datasets.cape_frames import CapeMeshes, read_cape_frame
from snarfcli.datasets.sources import Request
from snarfcli.datasets.splits import SPLITS, Split, split_sequences
from snarfcli.datasets.subjects import SequenceSpec, SubjectData, body_template
from snarfcli.errors import UserError, nearest
from snarfcli.formats.pickles import read_pickle
from snarfcli.motions import Motion
from snarfcli.names import folder_names
from snarfcli.progress import progress

__all__ = ["load", "subjects"]

log = logging.getLogger(__name__)

_FRAME_RATE = 60.0
_JOINTS = 24


def subjects(request: Request) -> tuple[str, ...]:
    """Return the available subjects, such as `00032_longshort`.

    Raises:
        UserError: there are none.
    """
    sequences = _release(request) / "sequences"
    found = {f"{folder.parent.name}_{folder.name.split('_')[0]}" for folder in sequences.glob("*/*_?*") if folder.is_dir()}
    if not found:
        raise UserError(f"no CAPE sequences in {sequences}; wanted folders such as 00032/longshort_hips; see data/README.md")
    return tuple(sorted(found))


def load(subject: str, request: Request) -> SubjectData:
    """Return one person in one outfit; frames that cannot be read are left out and listed.

    Raises:
        UserError: the subject, its gender, its minimal body or its body model is missing.
    """
    release = _release(request)
    person, outfit = _person_and_outfit(subject, subjects(request))
    body, sources = _minimal_body(person, release, request)
    skeleton = body.skeleton()
    places = [path for path in sorted((release / "sequences" / person).glob(f"{outfit}_?*")) if path.is_dir()]
    folders = dict(zip(folder_names(path.name.partition("_")[2] for path in places), places, strict=True))
    splits = split_sequences(tuple(folders), request.config.test, request.config.ood)
    steps: Mapping[Split, int] = {
        "train": request.config.frame_step, "test": request.config.test_frame_step, "ood": request.config.ood_frame_step,
    }  # fmt: skip
    sequences, broken = [], []
    for name, split in progress(splits.items(), total=len(splits), desc=f"reading {subject}", unit="sequences"):
        try:
            sequences.append(_sequence(name, split, folders[name], body, max(1, steps[split])))
        except UserError as error:
            broken.append((name, str(error)))
    sequences.sort(key=lambda spec: SPLITS.index(spec.split))
    template = body_template(body, np.zeros(0), skeleton)
    name = f"{person}_{outfit}"
    return SubjectData("cape", name, skeleton, tuple(sequences), template, np.zeros(0), sources, tuple(broken))


def _release(request: Request) -> Path:
    """Return the folder that holds `sequences`."""
    folder = request.folder
    places = [folder, folder / "cape_release", *sorted(folder.glob("*/cape_release")), *sorted(folder.glob("*/*/cape_release"))]
    for place in places:
        if (place / "sequences").is_dir():
            return place
    raise UserError(f"no cape_release/sequences (CAPE) below {folder}; see data/README.md, or give data.folder=FOLDER")


def _person_and_outfit(subject: str, known: Sequence[str]) -> tuple[str, str]:
    """Return the two parts of a subject's name; the outfit may be omitted if the person has only one."""
    number, _, outfit = subject.partition("_")
    number = number.zfill(5) if number.isdigit() else number
    matches = [name for name in known if name == f"{number}_{outfit}" or (not outfit and name.startswith(f"{number}_"))]
    if len(matches) != 1:
        several = f"subject {subject}: wanted one outfit, got {', '.join(matches)}; name one" if matches else ""
        raise UserError(several or f"no CAPE subject '{subject}'{nearest(subject, known)}; there is {', '.join(known)}")
    person, _, outfit = matches[0].partition("_")
    return person, outfit


def _minimal_body(person: str, release: Path, request: Request) -> tuple[Body, tuple[str, ...]]:
    """Return the SMPL body of a person, with the scanned minimal shape as template, and the files that were read."""
    genders_file = release / "misc" / "subj_genders.pkl"
    genders = read_pickle(genders_file, "list of genders")
    gender = genders.get(person) if isinstance(genders, dict) else None
    gender = gender.decode("latin1", "replace") if isinstance(gender, bytes) else gender
    if gender not in ("male", "female", "neutral"):
        raise UserError(f"{genders_file}: wanted male, female or neutral for {person}, got none; unpack the archive again")
    path = find_body(request.body or request.data_root, "smpl", gender)
    body = load_body(path)
    if body.num_joints != _JOINTS:
        raise UserError(f"body {path}: wanted SMPL's {_JOINTS} joints for CAPE, got {body.num_joints}; give body=FILE")
    minimal_file = release / "minimal_body_shape" / person / f"{person}_minimal.npy"
    minimal = read_npy(minimal_file, "minimal body")
    if minimal.shape != tuple(body.v_template.shape) or minimal.dtype.kind != "f" or not np.isfinite(minimal).all():
        wanted = f"finite numbers of shape {list(body.v_template.shape)}"
        raise UserError(f"minimal body {minimal_file}: wanted {wanted}, got {list(minimal.shape)}; unpack the archive again")
    body = replace(body, v_template=torch.as_tensor(minimal).to(body.v_template))
    return body, (f"body {path} ({gender})", f"minimal body {minimal_file}")


def _sequence(name: str, split: Split, folder: Path, body: Body, step: int) -> SequenceSpec:
    """Read every `step`-th frame of a sequence once, to find those that can be used."""
    paths = sorted(folder.glob("*.npz"))
    poses = np.zeros((max(len(paths), 1), body.num_joints, 3))
    usable, reasons = [], []
    for frame in range(0, len(paths), step):
        try:
            poses[frame] = read_cape_frame(paths[frame], len(body.v_template))["pose"].reshape(-1, 3)
            usable.append(frame)
        except UserError as error:
            reasons.append(str(error))
    if not usable:
        raise UserError(reasons[0] if reasons else f"{folder} has no .npz file; unpack the archive again")
    if reasons:
        more = f" ({reasons[0]}{', ...' if len(reasons) > 1 else ''})"
        counts = len(reasons), len(usable) + len(reasons)
        log.warning("%s: %d of %d frames cannot be read and are left out%s", name, *counts, more)
    motion = Motion(name, poses, np.zeros((len(poses), 3)), _FRAME_RATE)
    meshes = CapeMeshes(paths, body.faces.numpy().astype(np.int32))
    return SequenceSpec(name, split, motion, meshes, frames=np.array(usable))
