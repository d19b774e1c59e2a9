"""Settings of `snarf export`."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

from omegaconf import MISSING

from snarfcli.checks import check_choice
from snarfcli.commands.selection import AvatarSelection, MotionSelection, check_motion_selection
from snarfcli.export.blender import BLENDER_FORMATS
from snarfcli.export.bvh import BVH_ORDERS, UNITS
from snarfcli.export.character import CharacterOptions, check_options
from snarfcli.export.clips import HEIGHTS
from snarfcli.export.html import HtmlConfig
from snarfcli.export.joint_naming import NAMINGS
from snarfcli.export.vrm_meta import VrmMeta, check_meta
from snarfcli.meshing.mesh_files import MESH_WRITERS

__all__ = ["FOLDER_FORMATS", "FORMATS", "BvhConfig", "ExportConfig", "PretrainedConfig", "check_settings"]

log = logging.getLogger(__name__)

FORMATS = ("glb", "html", "vrm", "bvh", "pretrained", *MESH_WRITERS, *BLENDER_FORMATS)
"""Choices for the format."""
FOLDER_FORMATS = ("pretrained", *MESH_WRITERS)
"""Formats that are a folder."""
_SKELETONS = ("avatar", "file")


@dataclass
class BvhConfig:
    """Settings of format=bvh."""

    units: str = MISSING
    """Unit of length: cm, m, mm, or auto: cm on the avatar's skeleton, as in the file on the file's."""
    up: str = MISSING
    """Up axis that is written: y, z, or auto: y on the avatar's skeleton, as in the file on the file's."""
    order: str = MISSING
    """Order of rotations: ZXY, ZYX, XYZ, XZY, YXZ or YZX for all joints, or auto: ZXY, another for joints near gimbal lock."""


@dataclass
class PretrainedConfig:
    """Settings of format=pretrained."""

    license: str | None = None
    """Licence of the avatar in its model card, a sentence; null for that of the data set."""


@dataclass
class ExportConfig(MotionSelection, AvatarSelection):
    """Settings of `snarf export`."""

    pose: list[str] | None = MISSING
    """Motion files (.npz of AMASS, .pkl of AIST++, .npy, .bvh, .glb, .vrma) or folders of frames; each becomes one clip."""
    motion: list[str] | None = MISSING
    """Built-in motions (SMPL) or sequences of the samples (other skeletons); each becomes one clip. Without motions and pose
    files: jumping_jacks or the held-out sequence."""
    format: str = MISSING
    """glb (mesh, rig, clips and shapes in one file), html (the same as a page that plays offline, at most 5 MB), fbx or usd
    (the same, needs Blender), vrm (the same for VRM 1.0, with one .vrma per clip), bvh (the motion only, one file per clip),
    ply or obj (one mesh per frame), pretrained (the avatar itself, as Avatar.from_pretrained and ckpt=FOLDER read it, with a
    model card)."""
    names: str | None = MISSING
    """Names of the joints of a human: smpl, mixamo, vrm or unreal; null for the skeleton's own."""
    skeleton: str = MISSING
    """Skeleton of format=bvh: avatar, or file (that of the motion file, or of an average adult; needs no avatar)."""
    triangles: int | None = MISSING
    """Maximum number of triangles; null does not simplify the mesh."""
    influences: int = MISSING
    """Maximum number of joints per vertex: 4, or 8, which fewer programs read."""
    morph_targets: int = MISSING
    """Maximum number of morph targets for the pose-dependent shape; 0 uses the mean shape over the clips."""
    resolution: int = MISSING
    """Voxels along the longest side of the canonical box in which the mesh is extracted."""
    weight_colors: bool = MISSING
    """Colour vertices by their skinning weights."""
    height: str = MISSING
    """Height of the clips: ground (lowest point of each at y = 0), file (as in the motion), or auto: ground for built-in
    motions, file for pose files."""
    bvh: BvhConfig = MISSING
    """Settings of format=bvh."""
    vrm: VrmMeta = field(default_factory=VrmMeta)
    """Settings of format=vrm."""
    html: HtmlConfig = field(default_factory=HtmlConfig)
    """Settings of format=html."""
    pretrained: PretrainedConfig = field(default_factory=PretrainedConfig)
    """Settings of format=pretrained."""
    output: str | None = MISSING
    """Output file, or folder for ply, obj and pretrained; null for export/<subject>.<format> beside the avatar."""
    overwrite: bool = MISSING
    """Replace existing output."""
    wait: bool = False
    """Wait while another command writes the output, instead of stopping with an error."""
    experiment: str | None = None
    """Preset of settings, which other settings override; null for none."""


def check_settings(config: ExportConfig) -> CharacterOptions:
    """Check all settings before any work starts; return the options of the character.

    Raises:
        UserError: a setting cannot be used.
    """
    check_choice("format", config.format, FORMATS)
    check_choice("height", config.height, HEIGHTS)
    check_choice("skeleton", config.skeleton, _SKELETONS)
    if config.names is not None:
        check_choice("names", config.names, NAMINGS)
    check_choice("bvh.units", config.bvh.units, ("auto", *UNITS))
    check_choice("bvh.up", config.bvh.up, ("auto", "y", "z"))
    check_choice("bvh.order", config.bvh.order, BVH_ORDERS)
    check_meta(config.vrm)
    options = CharacterOptions(
        triangles=config.triangles,
        influences=config.influences,
        morph_targets=config.morph_targets,
        resolution=config.resolution,
        weight_colors=config.weight_colors,
    )
    check_options(options)
    check_motion_selection(config)
    _report_unused(config)
    return options


def _report_unused(config: ExportConfig) -> None:
    """Log settings that the format does not use: a message, not an error, since presets set them for all formats."""
    if config.format in MESH_WRITERS:
        given = [
            f"{name}={getattr(config, name)}"
            for name, usual in (
                ("influences", CharacterOptions.influences),
                ("morph_targets", CharacterOptions.morph_targets),
                ("names", None),
            )
            if getattr(config, name) != usual
        ]
        if given:
            text = "%s: not used with format=%s, whose meshes have all weights and the exact shape"
            log.warning(text, ", ".join(given), config.format)
    if config.format == "pretrained" and (config.pose or config.motion):
        log.warning("pose, motion: not used with format=pretrained, which is the avatar without motions")
    if config.format != "bvh" and config.skeleton != "avatar":
        log.warning("skeleton=%s: not used with format=%s", config.skeleton, config.format)
