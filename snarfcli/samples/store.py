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
from snarfcli.samples.layout import check_digest, check_format, check_sizes, read_arrays, repair_advice, samples_folder
from snarfcli.samples.sequence import SequenceSamples

__all__ = ["SampleStore"]

_ADVICE = {
    "train": "preprocess training sequences, or name data that has some (poseprior has none)",
    "test": "evaluate out of distribution (--ood), or preprocess held-out sequences (data.test=[NAME])",
    "ood": "leave out --ood, or preprocess out-of-distribution sequences (data.ood=[NAME]; PosePrior for dfaust)",
}


class SampleStore:
    """All processed samples of one subject."""

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        """Open the store in `folder`; `open` also checks that it exists and has the right version."""
        self.folder = folder
        self.manifest = manifest
        self.data: str = manifest["data"]
        self.subject: str = manifest["subject"]
        check_sizes(folder, manifest["files"])
        arrays = read_arrays(folder / "subject.npz")
        self.skeleton: Skeleton = Skeleton.from_dict(arrays)
        self.template: MeshTemplate | None = None
        """Mesh of the subject in the canonical pose, float32; None if the data set has none."""
        if "vertices_canonical" in arrays:
            self.template = MeshTemplate(arrays["vertices_canonical"], arrays["faces"], arrays["vertex_weights"])
        self.betas: np.ndarray = arrays["betas"]
        """[S], float32, shape parameters of the body model; S is 0 without a body model."""
        self._sequences = [SequenceSamples(folder / entry["split"] / entry["name"], entry) for entry in manifest["sequences"]]

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
        check_format(manifest, folder)
        try:
            return cls(folder, manifest)
        except (KeyError, TypeError) as error:
            raise UserError(
                f"the samples are damaged: {folder} lacks {error} or has another type of it; {repair_advice(folder)}"
            ) from None

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
