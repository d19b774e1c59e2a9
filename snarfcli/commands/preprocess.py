"""`snarf preprocess`: sample occupancy points from the posed meshes of a subject.

The samplers are imported inside `run`, because they load PyTorch and the mesh libraries, which --help does not need.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from omegaconf import MISSING

from snarfcli.datasets.settings import DataConfig
from snarfcli.errors import UserError
from snarfcli.texts import counted

__all__ = ["PreprocessConfig", "run"]

log = logging.getLogger(__name__)


@dataclass
class PreprocessConfig:
    """Settings of `snarf preprocess`."""

    subject: str = MISSING
    """Subject, such as 50002; all for every subject of the data set."""
    data: DataConfig = MISSING
    """Data set."""
    data_root: str = MISSING
    """Data folder; samples are written to <data_root>/processed/<data>/<subject>."""
    body: str | None = MISSING
    """Body model file, or a folder with it (under its original file name); null searches below data_root."""
    points_per_frame: int = MISSING
    """Number of points per frame, a multiple of 8: half uniform in the sampling cube, half near the surface."""
    surface_noise_m: float = MISSING
    """Standard deviation of the normal noise that moves points off the surface, along each axis, metres."""
    padding: float = MISSING
    """Sampling cube: its side exceeds the longest side of the mesh's bounding box by this share of that side."""
    inside_test: str = MISSING
    """Test for inside points: winding (points in overlapping parts are inside) or parity (outside, as in the papers' code)."""
    poisson: str = MISSING
    """What spreads points over the surface: pymeshlab (licence GPL-3), own, or auto for pymeshlab if it can be used."""
    workers: int = MISSING
    """Number of worker processes; 0 for one per core."""
    seed: int = MISSING
    """Seed of the random points; the samples do not depend on the number of workers."""
    overwrite: bool = MISSING
    """Delete existing samples and start again."""
    wait: bool = False
    """Wait while another command makes samples of the subject, instead of stopping with an error."""
    sequences: list[str] = MISSING
    """Names of the sequences to sample; empty for all."""
    skip_broken: bool = MISSING
    """Leave out sequences that cannot be used, and list them, instead of stopping with an error."""
    experiment: str | None = None
    """Preset of settings, which other settings override; null for none."""


def run(config: PreprocessConfig) -> None:
    """Sample one subject or all subjects; existing samples are kept, unless `overwrite` is set.

    Raises:
        UserError: a setting cannot be used, a subject or sequence is unknown, or existing samples have other settings.
        OSError: the data folder cannot be written to, or the disk is full.
    """
    from snarfcli.datasets.registry import find_dataset
    from snarfcli.datasets.sources import Request
    from snarfcli.parallel import count_cores
    from snarfcli.samples.preprocessing import preprocess_subject
    from snarfcli.sampling import SamplingSettings, choose_poisson

    dataset = find_dataset(config.data.name)
    sampling = SamplingSettings(
        points_per_frame=config.points_per_frame,
        surface_noise_m=config.surface_noise_m,
        padding=config.padding,
        inside_test=config.inside_test,
        seed=config.seed,
        poisson=choose_poisson(config.poisson),
    )
    frame_steps = {
        "train": config.data.frame_step,
        "test": config.data.test_frame_step,
        "ood": config.data.ood_frame_step,
    }
    for split, step in frame_steps.items():
        if step < 1:
            raise UserError(f"data: wanted a frame step of at least 1 for {split} sequences, got {step}")
    if config.workers < 0:
        raise UserError(f"workers: wanted a number of processes, or 0 for one per core, got {config.workers}")
    workers = config.workers or count_cores()
    request = Request(config.data, Path(config.data_root), config.body)
    for subject in dataset.subjects(request) if config.subject == "all" else [config.subject]:
        data = dataset.load(subject, request)
        log.info("subject %s of %s data, %s", data.subject, data.data, counted(workers, "process", "processes"))
        for line in data.sources:
            log.info("from %s", line)
        for line in data.warnings:
            log.warning("%s", line)
        preprocess_subject(
            data,
            config.data_root,
            sampling,
            frame_steps,
            workers=workers,
            overwrite=config.overwrite,
            wait=config.wait,
            sequences=config.sequences,
            skip_broken=config.skip_broken,
        )
