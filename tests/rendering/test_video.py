from __future__ import annotations

import imageio_ffmpeg
import numpy as np
import pytest

from snarfcli.errors import UserError
from snarfcli.rendering.video import write_video


def read_back(path):
    reader = imageio_ffmpeg.read_frames(str(path))
    facts = next(reader)
    width, height = facts["size"]
    return facts, [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


def pictures(count, height, width):
    for index in range(count):
        picture = np.full((height, width, 3), 40, np.uint8)
        picture[:, : width * (index + 1) // count] = (200, 120, 60)
        yield picture


def test_frames_size_and_rate_read_back(tmp_path):
    path = tmp_path / "folder" / "video.mp4"
    assert write_video(path, pictures(9, 48, 64), 12.5) == 9
    facts, frames = read_back(path)
    assert facts["size"] == (64, 48)
    assert facts["codec"] == "h264"
    assert "yuv420p" in facts["pix_fmt"]
    assert facts["fps"] == pytest.approx(12.5)
    assert len(frames) == 9
    for picture, frame in zip(pictures(9, 48, 64), frames, strict=True):
        assert np.abs(picture.astype(int) - frame).mean() < 6
    assert [p.name for p in path.parent.iterdir()] == ["video.mp4"]


def test_odd_sizes_are_made_even(tmp_path):
    write_video(tmp_path / "video.mp4", pictures(2, 33, 51), 60)
    assert read_back(tmp_path / "video.mp4")[0]["size"] == (52, 34)


def test_the_index_comes_first(tmp_path):
    write_video(tmp_path / "video.mp4", pictures(3, 32, 32), 30)
    content = (tmp_path / "video.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")


def test_a_failure_leaves_nothing(tmp_path):
    def broken():
        yield np.zeros((32, 32, 3), np.uint8)
        raise RuntimeError("the renderer fell")

    with pytest.raises(RuntimeError, match="the renderer fell"):
        write_video(tmp_path / "video.mp4", broken(), 30)
    assert not list(tmp_path.iterdir())


def test_a_video_that_is_cut_off_is_not_kept(tmp_path, capfd):
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    noise = np.random.default_rng(0).integers(0, 256, (40, 64, 64, 3)).astype(np.uint8)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))  # as on a full disk
    try:
        with pytest.raises(UserError, match=r"video .*video.mp4 could not be encoded \(.*\); check the free space"):
            write_video(tmp_path / "video.mp4", iter(noise), 30)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("frames", "rate", "message"),
    [
        ([], 30, "frames: wanted at least one picture"),
        ([np.zeros((32, 32, 3), np.uint8), np.zeros((32, 34, 3), np.uint8)], 30, "frames: wanted all of size"),
        ([np.zeros((32, 32, 3))], 30, "frames: wanted .* uint8"),
        ([np.zeros((32, 32, 3), np.uint8)], 0, "frame_rate: wanted a positive number"),
    ],
)
def test_wrong_arguments_are_named(tmp_path, frames, rate, message):
    with pytest.raises(ValueError, match=message):
        write_video(tmp_path / "video.mp4", iter(frames), rate)
    assert not list(tmp_path.iterdir())
