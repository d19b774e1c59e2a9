"""PosePrior (MPI_Limits in AMASS) alone: the out-of-distribution poses, on the body of a DFaust subject."""

from __future__ import annotations

from snarfcli.datasets import dfaust
from snarfcli.datasets.amass_files import amass_sequences, find_sequences, papers_split, read_amass_subject
from snarfcli.datasets.sources import Request
from snarfcli.datasets.splits import same_split
from snarfcli.datasets.subjects import SubjectData, body_template
from snarfcli.errors import UserError

__all__ = ["load", "subjects"]

subjects = dfaust.subjects


def load(subject: str, request: Request) -> SubjectData:
    """Return PosePrior's sequences on the body of one DFaust subject, all out of distribution.

    Raises:
        UserError: files of PosePrior, files of the subject (which give the shape), or the body model are missing.
    """
    prior = papers_split()["poseprior"]
    extremes = find_sequences(request.folder, prior["subject"], prior["ood"])
    if not extremes:
        raise UserError(
            f"no PosePrior sequences below {request.folder}: wanted AMASS files such as MPI_Limits/{prior['subject']}/"
            "op2_poses.npz; see data/README.md, or give data.folder=FOLDER"
        )
    person = read_amass_subject(dfaust.require_subject_files(subject, request)[0], request)
    splits = same_split(prior["ood"], "ood")
    sequences, broken = amass_sequences(extremes, splits, person, request.config.hands, request.folder)
    template = body_template(person.body, person.betas, person.skeleton)
    sources = (*person.sources, f"poses {next(iter(extremes.values())).parent}")
    return SubjectData("poseprior", subject, person.skeleton, tuple(sequences), template, person.betas, sources, tuple(broken))
