"""`snarf doctor --pose FILE`: how a motion file is read and put on a body, with a figure of both skeletons."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch

from snarfcli.bodies import MeshTemplate, Skeleton, builtin_body, forward_kinematics
from snarfcli.bodies.skinning import skin_vertices
from snarfcli.datasets.registry import find_dataset
from snarfcli.datasets.sources import Request
from snarfcli.datasets.subjects import body_template
from snarfcli.meshing.mesh import Mesh
from snarfcli.motions.motion import Motion
from snarfcli.motions.reader import read_motion_and_source
from snarfcli.motions.retarget import Retargeted
from snarfcli.motions.up_axis import Up
from snarfcli.rendering.bones import PosedSkeleton, write_skeletons_figure
from snarfcli.texts import counted

__all__ = ["PoseQuestion", "check_pose"]

log = logging.getLogger(__name__)

_FRAMES_DRAWN = 4
_LISTED = 12  # joints on one line


@dataclass(frozen=True)
class PoseQuestion:
    """A motion file, how to read it, and on which body to put it."""

    pose: str
    up: str
    hands: str
    rest: str
    mapping: str | None
    clip: str | None
    request: Request | None
    """Data set of the body; None for the built-in body."""
    subject: str | None
    """Subject of the data set; None for its first."""


def check_pose(question: PoseQuestion, figure: Path) -> None:
    """Print what was read from a motion file, and draw the file's skeleton beside the body that it moves.

    Raises:
        UserError: the file cannot be read, or does not fit the body.
    """
    skeleton, template, body = _body(question.request, question.subject)
    log.info("motion %s on %s", question.pose, body)
    motion, source = read_motion_and_source(
        question.pose,
        skeleton,
        up=cast(Up, question.up),
        hands=question.hands,
        rest=question.rest,
        mapping=question.mapping,
        clip=question.clip,
    )
    seconds = motion.num_frames / motion.frame_rate
    frames = counted(motion.num_frames, "frame")
    _tell("motion", f"{motion.name}: {frames} at {motion.frame_rate:g} per second, {seconds:.1f} s")
    if source is not None:
        _tell_pairs(skeleton, source)
    way = motion.translation[:, [0, 2]]
    _tell("way", f"{np.linalg.norm(np.diff(way, axis=0), axis=1).sum():.2f} m along the floor")
    numbers = np.unique(np.linspace(0, motion.num_frames - 1, _FRAMES_DRAWN).round().astype(int))
    posed = _posed_body(skeleton, template, motion, numbers)
    rows = [("on the body", posed)]
    if source is not None:
        drawn = [
            PosedSkeleton(source.source[number], source.source_parents, heading_rad=each.heading_rad)
            for number, each in zip(numbers, posed, strict=True)
        ]
        rows.insert(0, ("in the file", drawn))
    columns = [f"frame {number}" for number in numbers]
    write_skeletons_figure(figure, f"{Path(question.pose).name} on {body}", columns, rows)
    _tell("figure", str(figure))


def _body(request: Request | None, subject: str | None) -> tuple[Skeleton, MeshTemplate | None, str]:
    """Return the skeleton of a body, its mesh if it has one, and what it is called."""
    if request is None:
        body = builtin_body()
        skeleton = body.skeleton()
        return skeleton, body_template(body, np.zeros(body.num_betas), skeleton), "the built-in body"
    data_set = find_dataset(request.config.name)
    data = data_set.load(subject or data_set.subjects(request)[0], request)
    return data.skeleton, data.template, f"subject {data.subject} of {data.data}"


def _tell_pairs(skeleton: Skeleton, source: Retargeted) -> None:
    pairs = [f"{skeleton.names[joint]} from {source.source_names[number]}" for joint, number in source.pairs.items()]
    _tell("joints", f"{len(pairs)} of the body's {skeleton.num_joints} have one of the file's {len(source.source_names)}:")
    for first in range(0, len(pairs), _LISTED):
        _tell("", ", ".join(pairs[first : first + _LISTED]))


def _tell(name: str, text: str) -> None:
    log.info("  %-16s%s", name, text)


def _posed_body(skeleton: Skeleton, template: MeshTemplate | None, motion: Motion, numbers: np.ndarray) -> list[PosedSkeleton]:
    """Return the body in some frames of a motion."""
    poses, translation = torch.from_numpy(motion.poses[numbers]), torch.from_numpy(motion.translation[numbers])
    joints, transforms = forward_kinematics(poses, skeleton.joints_rest.double(), skeleton.parents, translation)
    headings = transforms[:, 0, :3, 2].numpy()  # where the pelvis faces
    meshes: list[Mesh | None] = [None] * len(numbers)
    if template is not None and len(template.faces):
        moved = skeleton.to(torch.float64).posed_from_canonical(poses, translation).numpy()
        posed = skin_vertices(template.vertices, template.weights, moved)
        meshes = [Mesh(vertices.astype(np.float32), template.faces.astype(np.int32)) for vertices in posed]
    return [
        PosedSkeleton(places, skeleton.parents, mesh, math.atan2(heading[0], heading[2]))
        for places, mesh, heading in zip(joints.numpy(), meshes, headings, strict=True)
    ]
