"""Settings of `snarf animate`."""

from __future__ import annotations

from dataclasses import dataclass

from omegaconf import MISSING

from snarfcli.commands.selection import AvatarSelection, MotionSelection

__all__ = ["AnimateConfig"]


@dataclass
class AnimateConfig(MotionSelection, AvatarSelection):
    """Settings of `snarf animate`."""

    pose: str | None = MISSING
    """Motion file (.npz of AMASS, .pkl of AIST++, .npy, .bvh, .glb, .vrma) or folder of frames; null uses `motion`."""
    motion: str | None = MISSING
    """Without a pose file: a built-in motion (SMPL) or a sequence of the samples (other skeletons); null for jumping_jacks
    or the held-out sequence."""
    surface: str = MISSING
    """field (extracted from the posed field, watertight) or skinned (the canonical mesh, moved by its skinning weights)."""
    resolution: int = MISSING
    """Voxels along the longest side, 16 to 1024, such as 128, 256 or 512."""
    keep_share: float = MISSING
    """Remove loose pieces with fewer faces than this share of the faces of the largest piece."""
    meshes: bool = MISSING
    """Write one mesh per frame."""
    format: str = MISSING
    """Format of the meshes: ply or obj."""
    weight_colors: bool = MISSING
    """Colour vertices by their skinning weights."""
    video: bool = MISSING
    """Write a video."""
    video_size: str = MISSING
    """Pixels of one panel of the video: 512, or width x height such as 1280x720. Each view and content is one panel."""
    views: list[str] = MISSING
    """Views, shown side by side: front, left, back, right (of the body), top, or degrees towards the body's left."""
    azimuth_deg: float = MISSING
    """Degrees by which all views except top are turned towards the body's left; 0 uses the named views exactly."""
    elevation_deg: float = MISSING
    """Degrees that the camera looks down, in all views except top."""
    camera: str = MISSING
    """still (shows the whole motion) or follow (moves with the body)."""
    turntable: str = MISSING
    """Turn the camera around the body: false, true (one turn in eight seconds), or degrees per second."""
    beside: list[str] = MISSING
    """Further panels: canonical (canonical shape under this pose), truth (ground-truth mesh, if there is one), skinned or field
    (the other surface), weights (the skinned surface, coloured by its skinning weights)."""
    output: str | None = MISSING
    """Output folder; null for animation/<motion> beside the avatar."""
    overwrite: bool = MISSING
    """Start again and replace existing frames, also those of other settings."""
    wait: bool = False
    """Wait while another command writes to the output folder, instead of stopping with an error."""
    processes: str = MISSING
    """Number of processes, which share the threads; auto: one per core if memory allows. With a GPU, one process extracts all
    surfaces and the others only draw."""
    experiment: str | None = None
    """Preset of settings, which other settings override; null for none."""
