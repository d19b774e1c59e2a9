"""Write videos that play in browsers: H.264 in MP4, one picture in memory at a time."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from snarfcli.files import atomic_path

__all__ = ["write_video"]

# Constant rate factor: 18 is visually lossless (x264 documentation); a standing body takes about 50 kB per second.
_QUALITY = 18


def write_video(path: str | Path, frames: Iterable[np.ndarray], frame_rate: float, *, quality: int = _QUALITY) -> int:
    """Write pictures as an MP4 file (H.264, yuv420p), whole or not at all.

    Args:
        path: name of the file, ends in .mp4.
        frames: [H, W, 3] uint8 each, all of one size; an odd last row or column is repeated, as yuv420p needs even sizes.
        frame_rate: pictures per second; fractions are kept.
        quality: constant rate factor of x264; lower is better.

    Returns:
        Number of pictures written.

    Raises:
        ValueError: there are no pictures, their sizes differ, or the frame rate is not positive.
        OSError: the file cannot be written, or the encoder failed.
    """
    import imageio_ffmpeg

    if not (np.isfinite(frame_rate) and frame_rate > 0):
        raise ValueError(f"frame_rate: wanted a positive number, got {frame_rate}")
    count = 0
    height = width = 0
    writer = None
    with atomic_path(path) as temporary:
        try:
            for frame in frames:
                if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
                    raise ValueError(f"frames: wanted [H, W, 3] uint8, got {list(frame.shape)} {frame.dtype}")
                if writer is None:
                    height, width = frame.shape[:2]
                    writer = imageio_ffmpeg.write_frames(
                        str(temporary),
                        (width + width % 2, height + height % 2),
                        fps=frame_rate,  # pyright: ignore[reportArgumentType]  # fractions work, the stub says int
                        codec="libx264",
                        pix_fmt_in="rgb24",
                        pix_fmt_out="yuv420p",
                        macro_block_size=2,
                        ffmpeg_log_level="error",
                        # faststart puts the index first, so that a browser can play before it has the whole file.
                        output_params=["-crf", str(quality), "-preset", "medium", "-movflags", "+faststart"],
                    )
                    writer.send(None)
                if frame.shape[:2] != (height, width):
                    raise ValueError(f"frames: wanted all of size {[height, width, 3]}, got {list(frame.shape)}")
                even = np.pad(frame, np.array([(0, height % 2), (0, width % 2), (0, 0)]), mode="edge")
                writer.send(np.ascontiguousarray(even))
                count += 1
        finally:
            if writer is not None:
                writer.close()
        if count == 0:
            raise ValueError(f"frames: wanted at least one picture for {path}, got none")
        if not temporary.is_file() or temporary.stat().st_size == 0:
            raise OSError(f"{path}: wanted a video, got an empty file from the encoder")
    return count
