"""The processed samples of one subject; `layout.py` describes the files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from snarfcli.bodies.skeleton import Skeleton
from snarfcli.bodies.template import MeshTemplate
from snarfcli.datasets.splits import SPLITS
from snarfcli.errors import UserError, nearest
from snarfcli.files import read_json
from snarfcli.samples.layout import check_digest, check_sizes, checked_array, read_arrays, repair_advice, samples_folder
from snarfcli.samples.manifests import check_manifest
from snarfcli.samples.sequence import SequenceSamples
from snarfcli.texts import one_line

__all__ = ["SampleStore"]

_ADVICE = {
    "train": "preprocess training sequences, or name data that has some (poseprior has none)",
    "test": "evaluate out of distribution (--ood), or preprocess held-out sequences (data.test=[NAME])",
    "ood": "leave out --ood, or preprocess out-of-distribution sequences (data.ood=[NAME]; PosePrior for dfaust)",
}


class SampleStore:
    """All processed samples of one subject."""

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        """Open the store in `folder`; `open` also checks its manifest.

        Raises:
            UserError: the samples are damaged.
        """
        self.folder = folder
        self.manifest = manifest
        self.data: str = manifest["data"]
        self.subject: str = manifest["subject"]
        self.is_planar: bool = manifest["settings"].get("is_planar", False)  # only samples of planar subjects have it
        """Whether the subject is planar: all samples have z = 0."""
        check_sizes(folder, manifest["files"])
        arrays = read_arrays(folder / "subject.npz")
        try:
            self.skeleton: Skeleton = Skeleton.from_dict(arrays)
            self.template: MeshTemplate | None = _template(arrays, self.skeleton.num_joints, self.is_planar)
            """Mesh of the subject in the canonical pose, float32; None if the data set has none."""
            self.betas: np.ndarray = checked_array(arrays, "betas", np.float32, (None,))
            """[S], float32, shape parameters of the body model; S is 0 without a body model."""
        except (KeyError, TypeError, ValueError) as error:
            reason = f"no {error}" if isinstance(error, KeyError) else one_line(error, 200)
            raise UserError(f"the samples are damaged: {folder / 'subject.npz'}: {reason}; {repair_advice(folder)}") from None
        self._sequences = [SequenceSamples(folder / entry["split"] / entry["name"], entry) for entry in manifest["sequences"]]
        for sequence in self._sequences:
            if sequence.poses.shape[1] != self.skeleton.num_joints:
                there = (
                    f"{sequence.folder} has poses of {sequence.poses.shape[1]} joints, the subject {self.skeleton.num_joints}"
                )
                raise UserError(f"the samples are damaged: {there}; {repair_advice(folder)}")

    @classmethod
    def open(cls, root: str | Path, data: str, subject: str) -> SampleStore:
        """Open the samples of one subject.

        Args:
            root: the data folder; the samples are under `processed/{data}/{subject}`.
            data: name of the data set, such as `builtin`.
            subject: name of the subject.

        Raises:
            UserError: they are missing, unfinished, damaged, or of another format version; the message says what to do.
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
        check_manifest(manifest, folder)
        return cls(folder, manifest)

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
        """Compare every file with its checksum; this reads all files.

        Raises:
            UserError: one differs.
        """
        for name, entry in self.manifest["files"].items():
            check_digest(self.folder / name, entry["sha256"])
        for sequence in self._sequences:
            sequence.verify()


def _template(arrays: dict[str, np.ndarray], num_joints: int, is_planar: bool) -> MeshTemplate | None:
    """Return the mesh in `subject.npz`, or None if it has none.

    Raises:
        KeyError, ValueError: it is damaged.
    """
    if "vertices_canonical" not in arrays:
        return None
    vertices = checked_array(arrays, "vertices_canonical", np.float32, (None, 3))
    weights = checked_array(arrays, "vertex_weights", np.float32, (len(vertices), num_joints))
    faces = checked_array(arrays, "faces", np.int32, (None, 3))
    if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError(f"faces: wanted vertices from 0 to {len(vertices) - 1}, got others")
    return MeshTemplate(vertices, faces, weights, is_planar)
