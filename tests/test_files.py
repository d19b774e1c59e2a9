"""Files: whole or not at all, and nothing in them is executed."""

from __future__ import annotations

import errno
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from snarfcli.errors import UserError
from snarfcli.files import atomic_path, read_npz, write_json, write_tensors


def test_a_failed_write_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "a.json"
    write_json(path, {"a": 1})
    before = path.read_bytes()
    with pytest.raises(ValueError), atomic_path(path) as temporary:
        temporary.write_text("half")
        assert temporary.suffix == ".json"
        raise ValueError
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"a": float("nan")})
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["a.json"]


def test_a_full_disk_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(OSError) as caught, atomic_path(tmp_path / "a.bin"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.filename == str(tmp_path / "a.bin")
    (tmp_path / "file").touch()
    with pytest.raises(OSError):
        write_json(tmp_path / "file" / "a.json", {})


def test_tensors_come_back_and_a_full_disk_is_an_os_error(tmp_path: Path) -> None:
    write_tensors(tmp_path / "a.pt", {"x": torch.arange(3)})
    assert torch.load(tmp_path / "a.pt", weights_only=True)["x"].tolist() == [0, 1, 2]
    resource = pytest.importorskip("resource", reason="file sizes cannot be limited on this system")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OSError) as caught:
            write_tensors(tmp_path / "a.pt", {"x": torch.zeros(1000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.filename == str(tmp_path / "a.pt")
    assert [file.name for file in tmp_path.iterdir()] == ["a.pt"]
    assert torch.load(tmp_path / "a.pt", weights_only=True)["x"].tolist() == [0, 1, 2]


def test_archives_that_are_none_end_in_one_line(tmp_path: Path) -> None:
    np.savez(tmp_path / "good.npz", x=np.arange(3))
    good = (tmp_path / "good.npz").read_bytes()
    assert read_npz(tmp_path / "good.npz")["x"].tolist() == [0, 1, 2]
    (tmp_path / "cut.npz").write_bytes(good[:-30])
    (tmp_path / "text.npz").write_text("no zip")
    (tmp_path / "empty.npz").touch()
    np.savez(tmp_path / "pickled.npz", x=np.array([{}], dtype=object))
    locked = bytearray(good)
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):  # set the bit that says encrypted
        locked[locked.index(signature) + offset] |= 1
    (tmp_path / "locked.npz").write_bytes(locked)
    wrong = {
        "missing": "no body at", "cut": "truncated", "text": "not an .npz", "empty": "not an .npz",
        "pickled": "never executed", "locked": "damaged",
    }  # fmt: skip
    for name, message in wrong.items():
        with pytest.raises(UserError, match=message) as caught:
            read_npz(tmp_path / f"{name}.npz", "body")
        assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="is a folder"):
        read_npz(tmp_path)


def test_what_is_no_array_is_left_out(tmp_path: Path) -> None:
    np.savez(tmp_path / "mixed.npz", x=np.arange(3))
    with zipfile.ZipFile(tmp_path / "mixed.npz", "a") as archive:
        archive.writestr("poses", "bytes of no array")
    assert list(read_npz(tmp_path / "mixed.npz")) == ["x"]
