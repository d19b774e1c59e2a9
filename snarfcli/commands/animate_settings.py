"""What can be chosen about `snarf animate`."""

from __future__ import annotations

from dataclasses import dataclass

from omegaconf import MISSING

from snarfcli.commands.selection import AvatarSelection, MotionSelection

__all__ = ["AnimateConfig"]


@dataclass
class AnimateConfig(MotionSelection, AvatarSelection):
    """Settings of `snarf animate`."""

    pose: str | None = MISSING
    """Motion: .npz of AMASS, .pkl of AIST++, .npy, .bvh, .glb, .gltf, or a folder of frames; null for the built-in `motion`."""
    motion: str | None = MISSING
    """Without a pose file: a built-in motion of SMPL's joints, or a sequence of the samples of any other skeleton; null for
    jumping_jacks, or for the held-out sequence."""
    surface: str = MISSING
    """field (the union, watertight) or skinned (the canonical mesh moved by its skin)."""
    resolution: int = MISSING
    """Voxels along the longest side: 128, 256, 512 or any number from 16 to 1024."""
    keep_share: float = MISSING
    """Loose pieces with fewer faces than this share of the largest surface's are dropped."""
    meshes: bool = MISSING
    """Whether to write a mesh a frame."""
    format: str = MISSING
    """Format of the meshes: ply or obj."""
    weight_colors: bool = MISSING
    """Whether vertices are coloured by their skinning weights."""
    video: bool = MISSING
    """Whether to draw a video."""
    video_size: str = MISSING
    """Pixels of one panel of the video: 512, or width x height such as 1280x720. Several views or contents make it larger."""
    views: list[str] = MISSING
    """Sides to look from, side by side: front, left, back, right (of the body), top, or degrees towards the body's left."""
    azimuth_deg: float = MISSING
    """Degrees by which the cameras of all views but top are turned towards the body's left; 0 takes the views by their word."""
    elevation_deg: float = MISSING
    """Degrees that the camera looks down, in all views but top."""
    camera: str = MISSING
    """still (it sees the whole motion) or follow (it goes along with the body)."""
    turntable: str = MISSING
    """Whether the camera goes round the body: false, true (a turn in eight seconds), or degrees a second."""
    beside: list[str] = MISSING
    """What is shown beside the avatar: canonical (its canonical shape in this pose), truth (the true posed mesh, where there is
    one), skinned or field (the other surface), weights (the skinned surface, coloured by its weights)."""
    output: str | None = MISSING
    """Folder for the results; null for animation/<motion> beside the avatar."""
    overwrite: bool = MISSING
    """Start again, even over frames made with other settings."""
    processes: str = MISSING
    """Processes that make frames at the same time, sharing the threads: auto (one a core as memory allows) or a number. With a
    GPU one process extracts all surfaces, and they only draw."""
    experiment: str | None = None
    """Name of the preset of settings that the rest starts from; null for none."""
