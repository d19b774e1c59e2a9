"""Write videos that play in browsers: H.264 in MP4, one picture in memory at a time."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from snarfcli.errors import UserError
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
        UserError: the encoder failed, for example because the disk is full.
        OSError: the file cannot be written.
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
                        ffmpeg_log_level="quiet",  # it would print its errors between the messages of the command
                        # faststart puts the index first, so that a browser can play before it has the whole file.
                        output_params=["-crf", str(quality), "-preset", "medium", "-movflags", "+faststart"],
                    )
                    writer.send(None)
                if frame.shape[:2] != (height, width):
                    raise ValueError(f"frames: wanted all of size {[height, width, 3]}, got {list(frame.shape)}")
                even = np.pad(frame, np.array([(0, height % 2), (0, width % 2), (0, 0)]), mode="edge")
                try:
                    writer.send(np.ascontiguousarray(even))
                except OSError:
                    raise _not_encoded(path, "the encoder ended early") from None
                count += 1
        finally:
            if writer is not None:
                writer.close()
        if count == 0:
            raise ValueError(f"frames: wanted at least one picture for {path}, got none")
        if not _is_whole(temporary):  # as after a full disk, which imageio does not report
            raise _not_encoded(path, "the file is not complete")
    return count


def _not_encoded(path: Path | str, reason: str) -> UserError:
    advice = "check the free space on the disk, then run the command again"
    return UserError(f"video {path} could not be encoded ({reason}); {advice}")


def _is_whole(path: Path) -> bool:
    """Return whether an MP4 file has all its parts: whole boxes, with the index in front of the pictures."""
    if not path.is_file():
        return False
    size, place, boxes = path.stat().st_size, 0, []
    with path.open("rb") as file:
        while place + 8 <= size:
            file.seek(place)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            length = int.from_bytes(head[8:], "big") if length == 1 else length  # 64 bits, for more than 4 GiB
            if length < 8:
                return False
            boxes.append(head[4:8])
            place += length
    return place == size and b"mdat" in boxes and b"moov" in boxes[: boxes.index(b"mdat")]
