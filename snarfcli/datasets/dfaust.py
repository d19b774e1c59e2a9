"""DFaust from AMASS: the subjects and split of the papers; PosePrior's sequences, if present, are out of distribution.

Targets are posed SMPL bodies; soft-tissue motion (dmpls) is left out (SNARF Sec. 4.1).
"""

from __future__ import annotations

import logging
from pathlib import Path

from snarfcli.checks import check_choice
from snarfcli.datasets.amass_files import amass_sequences, find_sequences, find_subjects, papers_split, read_amass_subject
from snarfcli.datasets.sources import Request
from snarfcli.datasets.splits import Split, same_split
from snarfcli.datasets.subjects import SubjectData, body_template
from snarfcli.errors import UserError, nearest
from snarfcli.motions.layouts import HANDS

__all__ = ["load", "require_subject_files", "subjects"]

log = logging.getLogger(__name__)


def subjects(request: Request) -> tuple[str, ...]:
    """Return the ids of the papers' subjects that have files.

    Raises:
        UserError: there are none.
    """
    known = tuple(papers_split()["dfaust"])
    found = find_subjects(request.folder, known)
    if not found:
        raise UserError(_nothing(f"of the subjects {', '.join(known)}", known[0], request))
    return found


def load(subject: str, request: Request) -> SubjectData:
    """Return one subject in the split of the papers.

    Raises:
        UserError: the subject is unknown, or has no files or no body model.
    """
    files, splits = require_subject_files(subject, request)
    person = read_amass_subject(files, request)
    hands = request.config.hands
    sequences, broken = amass_sequences(files, splits, person, hands, request.folder)
    prior = papers_split()["poseprior"]
    extremes = find_sequences(request.folder, prior["subject"], prior["ood"])
    if extremes:
        splits = same_split(prior["ood"], "ood")
        more, missing = amass_sequences(extremes, splits, person, hands, request.folder)
        sequences, broken = sequences + more, broken + missing
    else:
        log.warning(
            "no PosePrior (MPI_Limits) below %s, so no out-of-distribution poses; put it there and run the command again",
            request.folder,
        )
    template = body_template(person.body, person.betas, person.skeleton)
    return SubjectData(
        "dfaust", subject, person.skeleton, tuple(sequences), template, person.betas, person.sources, tuple(broken)
    )


def require_subject_files(subject: str, request: Request) -> tuple[dict[str, Path], dict[str, Split]]:
    """Return the files of a subject's sequences, and the papers' split of each sequence.

    Raises:
        UserError: the subject is unknown or has no files, or data.hands is not a valid choice.
    """
    check_choice("data.hands", request.config.hands, HANDS)
    split = papers_split()["dfaust"]
    if subject not in split:
        raise UserError(f"no DFaust subject '{subject}'{nearest(subject, split)}; wanted one of {', '.join(split)}")
    splits = same_split(split[subject]["train"], "train") | same_split(split[subject]["test"], "test")
    files = find_sequences(request.folder, subject, splits)
    if not files:
        raise UserError(_nothing(f"of subject {subject}", subject, request))
    return files, splits


def _nothing(whose: str, subject: str, request: Request) -> str:
    return (
        f"no DFaust sequences {whose} below {request.folder}: wanted AMASS files such as "
        f"DFaust_67/{subject}/{subject}_hips_poses.npz; see data/README.md, or give data.folder=FOLDER"
    )
