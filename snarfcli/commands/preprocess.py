"""`snarf preprocess`: sample occupancies from the posed meshes of a subject."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from omegaconf import MISSING

from snarfcli.datasets.settings import DataConfig
from snarfcli.errors import UserError

__all__ = ["PreprocessConfig", "run"]

log = logging.getLogger(__name__)


@dataclass
class PreprocessConfig:
    """Settings of `snarf preprocess`."""

    subject: str = MISSING
    """The subject's id, such as 50002; `all` for every subject of the data set."""
    data: DataConfig = MISSING
    """The data set."""
    data_root: str = MISSING
    """The data folder; samples go under `processed/{data}/{subject}` in it."""
    body: str | None = MISSING
    """Body model, or a folder in which it lies under the name it is downloaded with; null: looked for below data_root."""
    points_per_frame: int = MISSING
    """Points a frame, a multiple of 8: half uniform in the papers' box, half near the surface."""
    surface_noise_m: float = MISSING
    """Standard deviation of the near-surface points' distance along each axis, metres."""
    padding: float = MISSING
    """How much longer the sampling cube is than the longest side of the mesh's box, as a share."""
    inside_test: str = MISSING
    """`winding`: overlapping parts are inside. `parity`: they are outside, as in the papers' released code."""
    workers: int = MISSING
    """Processes; 0: one a core."""
    seed: int = MISSING
    """Start of the random numbers; the samples do not depend on the number of workers."""
    overwrite: bool = MISSING
    """Discard the samples that are there and start again."""
    sequences: list[str] = MISSING
    """Names of the sequences to make; all if empty."""
    skip_broken: bool = MISSING
    """Leave out sequences that cannot be used, and list them, instead of stopping."""
    experiment: str | None = None
    """Name of the preset of settings that the rest starts from; null for none."""


def run(config: PreprocessConfig) -> None:
    """Make the samples of one subject or of all; what is there already is kept.

    Raises:
        UserError: a value cannot be used, a subject or sequence is unknown, or the samples there do not go with the settings.
        OSError: the data folder cannot be written to, or the disk is full.
    """
    from snarfcli.datasets.registry import find_dataset
    from snarfcli.datasets.request import DataRequest
    from snarfcli.parallel import count_cores
    from snarfcli.samples.preprocessing import preprocess_subject
    from snarfcli.sampling import SamplingSettings

    source = find_dataset(config.data.name)
    sampling = SamplingSettings(
        points_per_frame=config.points_per_frame,
        surface_noise_m=config.surface_noise_m,
        padding=config.padding,
        inside_test=config.inside_test,
        seed=config.seed,
    )
    steps = {
        "train": config.data.frame_step,
        "test": config.data.test_frame_step,
        "ood": config.data.ood_frame_step,
    }
    for split, step in steps.items():
        if step < 1:
            raise UserError(f"data: wanted a frame step of at least 1 for {split} sequences, got {step}")
    if config.workers < 0:
        raise UserError(f"workers: wanted a number of processes, or 0 for one a core, got {config.workers}")
    workers = config.workers or count_cores()
    request = DataRequest(config.data, Path(config.data_root), config.body)
    for subject in source.subjects(request) if config.subject == "all" else [config.subject]:
        data = source.load(subject, request)
        log.info("subject %s of %s data, %d processes", data.subject, data.data, workers)
        for line in data.sources:
            log.info("from %s", line)
        preprocess_subject(
            data,
            config.data_root,
            sampling,
            steps,
            workers=workers,
            overwrite=config.overwrite,
            sequences=config.sequences,
            skip_broken=config.skip_broken,
        )
