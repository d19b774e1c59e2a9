"""`snarf fit`: fit a body to scans without poses, and write the skeleton and the poses beside them.

What does the work is imported inside `run`, because it loads PyTorch, which --help does not need.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import MISSING

from snarfcli.checks import check_choice, check_number
from snarfcli.datasets.settings import DataConfig, command_settings
from snarfcli.errors import UserError

if TYPE_CHECKING:
    from snarfcli.datasets.sources import Request
    from snarfcli.scanned_subjects.fit_options import FitOptions

__all__ = ["FitConfig", "run"]

log = logging.getLogger(__name__)

_CLOTHES_M = 0.04  # below a shirt and trousers
_LOOSEST_M = 0.06  # with more the search for a pose, which does not know of clothes, goes wrong
_POINTS = (500, 100_000)
_FRAME_RATES = (0.01, 1000.0)
_GENDERS = ("neutral", "female", "male")


@dataclass
class FitConfig:
    """Settings of `snarf fit`."""

    subject: str = MISSING
    """Subject, the name of a folder with scans; all for every subject that has scans and no poses of others."""
    data: DataConfig = MISSING
    """Data set: meshes. data.scale sets the unit of the scans in metres, data.up their up axis (y or z)."""
    data_root: str = MISSING
    """Data folder; scans are read from <data_root>/meshes/<subject>/<sequence>, or from data.folder."""
    body: str | None = MISSING
    """Body model file in SMPL's format, or a folder with it; null for the built-in body."""
    skeleton: str | None = MISSING
    """A rig to fit in place of a body, such as an animal: a .glb with a skin, or a skeleton file with the mesh of the same name
    beside it; null for none."""
    gender: str = MISSING
    """Of the body model in a folder: neutral, female or male."""
    clothes: str = MISSING
    """Whether the person wears more than tight clothes: the body then stays inside the scan. false, true (4 cm), or metres."""
    points_per_frame: int = MISSING
    """Maximum number of points of a frame that are used."""
    ordered: str = MISSING
    """Whether the frames of a sequence show a motion: auto, true, or false (single frames in any order)."""
    frame_rate: float = MISSING
    """Frames per second of the scans, as the pose files say."""
    workers: int = MISSING
    """Number of worker processes, each for one sequence at a time; 0 for one per core."""
    seed: int = MISSING
    """Seed of the points that are used."""
    overwrite: bool = MISSING
    """Start again, and replace skeleton and pose files beside the scans, also those of others."""
    skip_broken: bool = MISSING
    """Scans that cannot be read become frames that are not trusted, instead of an error."""
    wait: bool = False
    """Wait while another command fits the subject, instead of stopping with an error."""


def run(config: FitConfig) -> int:
    """Fit one subject or all subjects; finished sequences are kept, unless `overwrite` is set.

    Returns:
        0, or 1 if some sequence has no poses, since none of its scans can be read.

    Raises:
        UserError: a setting cannot be used, a subject is unknown or cannot be fitted, or existing poses have other settings.
        OSError: the data folder cannot be written to, or the disk is full.
    """
    from snarfcli.datasets.mesh_folders import meshes_folder
    from snarfcli.datasets.sources import Request
    from snarfcli.scanned_subjects.subject_fit import fit_subject

    options = _options(config)
    request = Request(config.data, Path(config.data_root), config.body)
    subjects = list(_without_poses(request, config.overwrite)) if config.subject == "all" else [config.subject]
    if not subjects:
        raise UserError(f"nothing to fit in {meshes_folder(request)}; wanted <subject>/<sequence>/ with one scan per frame")
    is_whole = [fit_subject(subject, request, options) for subject in subjects]
    settings = command_settings(config.data, subjects[0], config.data_root)
    log.info('next: "snarf preprocess %s", then "snarf train %s training.refine_poses=true"', settings, settings)
    return 0 if all(is_whole) else 1


def _without_poses(request: Request, overwrite: bool) -> Iterator[str]:
    """Yield the subjects that have scans and no skeleton or poses of others."""
    from snarfcli.scanned_subjects.scans import find_scans, scan_subjects
    from snarfcli.scanned_subjects.written import foreign_files

    for subject in scan_subjects(request):
        try:
            place, folders = find_scans(subject, request)
        except UserError as error:  # a rigged file
            log.warning("left out: %s", error)
            continue
        if not overwrite and foreign_files(place, [folder.folder for folder in folders]):
            log.warning("left out: subject %s, which has a skeleton or poses that snarf fit has not written", subject)
        else:
            yield subject


def _options(config: FitConfig) -> FitOptions:
    """Check all settings before any work starts."""
    from snarfcli.datasets.recorded_sequence import check_scale
    from snarfcli.parallel import count_cores
    from snarfcli.scanned_subjects.fit_options import FitOptions
    from snarfcli.scanned_subjects.fitter import BodyChoice

    if config.data.name != "meshes":
        raise UserError(f"data: wanted meshes, got {config.data.name}, which has poses already; give data=meshes")
    check_choice("data.up", config.data.up, ("auto", "y", "z"))
    check_scale(config.data.scale)
    ordered = config.ordered.strip().lower()
    check_choice("gender", config.gender, _GENDERS)
    check_choice("ordered", ordered, ("auto", "true", "false"))
    check_number("points_per_frame", config.points_per_frame, *_POINTS)
    check_number("frame_rate", config.frame_rate, *_FRAME_RATES)
    check_number("seed", config.seed, 0)
    if config.body is not None and config.skeleton is not None:
        raise UserError("body, skeleton: wanted at most one of them, got both; leave one out")
    if config.workers < 0:
        raise UserError(f"workers: wanted a number of processes, or 0 for one per core, got {config.workers}")
    return FitOptions(
        BodyChoice(config.body, config.gender, config.skeleton),
        config.data.scale,
        config.data.up,
        _clothes_m(config.clothes),
        config.points_per_frame,
        ordered,
        config.frame_rate,
        config.seed,
        config.workers or count_cores(),
        config.overwrite,
        config.skip_broken,
        config.wait,
    )


def _clothes_m(text: str) -> float:
    """Return how far the body may be below the surface, metres."""
    word = text.strip().lower()
    if word in ("false", "true"):
        return _CLOTHES_M if word == "true" else 0.0
    try:
        metres = float(word)
    except ValueError:
        metres = math.nan
    if not 0 <= metres <= _LOOSEST_M:
        raise UserError(f"clothes: wanted true, false or 0 to {_LOOSEST_M} metres, got '{text}'")
    return metres
