"""Files are written complete or not at all, and nothing in them is executed."""

from __future__ import annotations

import errno
import os
import stat
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from snarfcli import array_files
from snarfcli.array_files import list_npz, map_npy, read_npy, read_npz
from snarfcli.cli.messages import user_message
from snarfcli.errors import UserError
from snarfcli.files import atomic_path, read_json, remove_temporaries, write_json, write_tensors
from snarfcli.formats.torch_files import read_plain_torch, read_torch


def test_a_failed_write_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "a.json"
    write_json(path, {"a": 1})
    before = path.read_bytes()

    def fail() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            assert temporary.suffix == ".json"
            raise ValueError("half-way")

    with pytest.raises(ValueError, match="half-way"):
        fail()
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"a": float("nan")})
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["a.json"]


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    fsync, replace = os.fsync, os.replace

    def noted_fsync(descriptor: int) -> None:
        done.append(f"flush {'folder' if stat.S_ISDIR(os.fstat(descriptor).st_mode) else 'file'}")
        fsync(descriptor)

    def noted_replace(old: Path, new: Path) -> None:
        done.append("rename")
        replace(old, new)

    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(os, "replace", noted_replace)
    write_json(tmp_path / "a.json", 1)
    assert done[:2] == ["flush file", "rename"]
    assert done[2:] == (["flush folder"] if os.name == "posix" else [])
    done.clear()
    with atomic_path(tmp_path / "frame_000000.ply", flush_name=False) as temporary:
        temporary.touch()
    assert done == ["flush file", "rename"]


def test_what_killed_processes_leave_is_known_by_its_name(tmp_path: Path) -> None:
    left = (".avatar.0123abcd.tmp.pt", ".run.e.0123abcd.tmp.pt", ".frame_000000.0123abcd.tmp.ply", ".README.0123abcd.tmp")
    others = (".avatar.tmp.pt", "avatar.0123abcd.tmp.pt", ".avatar.0123abcX.tmp.pt", ".lock", "avatar.pt")
    for name in (*left, *others):
        (tmp_path / name).touch()
    remove_temporaries(tmp_path, "avatar.pt", "README")
    assert {path.name for path in tmp_path.iterdir()} == {*others, *left[1:3]}
    remove_temporaries(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set(others)
    remove_temporaries(tmp_path / "missing")


@pytest.mark.parametrize("text", ["{", "[" * 100_000, "1" * 5000, "\xff", "", " " * (2**25 + 1)])
def test_what_is_no_json_is_rejected(tmp_path: Path, text: str) -> None:
    path = tmp_path / "split.json"
    path.write_bytes(text.encode("latin1"))
    with pytest.raises(UserError, match=r"^split .*split.json ") as caught:
        read_json(path, "split")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400
    for other, message in ((tmp_path, "is a folder"), (tmp_path / "none", "no split at")):
        with pytest.raises(UserError, match=message):
            read_json(other, "split")


def test_a_full_disk_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space") as caught, atomic_path(tmp_path / "a.bin"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.filename == str(tmp_path / "a.bin")
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        write_json(tmp_path / "file" / "a.json", {})


def test_tensors_come_back_and_a_full_disk_is_an_os_error(tmp_path: Path) -> None:
    write_tensors(tmp_path / "a.pt", {"x": torch.arange(3)})
    assert torch.load(tmp_path / "a.pt", weights_only=True)["x"].tolist() == [0, 1, 2]
    resource = pytest.importorskip("resource", reason="file sizes cannot be limited on this system")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OSError, match=r"a\.pt") as caught:
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


def packed(path: Path, *members: tuple[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return path


def npy(array: np.ndarray, **header: object) -> bytes:
    """The bytes of an .npy file, with entries of its header changed."""
    import io

    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(content, {**np.lib.format.header_data_from_array_1_0(array), **header})
    return content.getvalue() + array.tobytes()


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_archives_that_are_strange_end_in_one_line(tmp_path: Path) -> None:
    good = npy(np.arange(3))
    records = np.zeros(2, [("a", "f4"), ("b", "i4")])
    bomb = packed(tmp_path / "bomb.npz", ("x.npy", npy(np.zeros(10**8, np.int8))))
    assert bomb.stat().st_size < 2 * 10**5
    packed(tmp_path / "twice.npz", ("x.npy", good), ("x.npy", good))
    packed(tmp_path / "lzma.npz", ("x.npy", good), method=zipfile.ZIP_LZMA)
    packed(tmp_path / "records.npz", ("x.npy", npy(records)))
    packed(tmp_path / "absurd.npz", ("x.npy", npy(np.arange(3), shape=(10**12, 10**12))))
    packed(tmp_path / "nothing.npz", ("x.npy", npy(np.zeros(0, "V0"), shape=(10**12,))))
    packed(tmp_path / "long.npz", ("x.npy", good + b"more"))
    packed(tmp_path / "deep.npz", ("x.npy", npy(np.zeros(1), shape=(1,) * 99)))
    packed(tmp_path / "header.npz", ("x.npy", b"\x93NUMPY\x02\x00" + (2**31).to_bytes(4, "little") + bytes(100)))
    (tmp_path / "npy.npz").write_bytes(good)
    wrong = {
        "bomb": "unpacks to 95 MiB from .* KiB, which no real data does", "twice": "contains 'x' twice",
        "lzma": "unsupported compression",
        "records": "holds records", "absurd": "damaged", "nothing": "damaged", "long": "damaged", "deep": "damaged",
        "header": "damaged", "npy": "not an .npz",
    }  # fmt: skip
    for name, message in wrong.items():
        with pytest.raises(UserError, match=message) as caught:
            read_npz(tmp_path / f"{name}.npz", "body")
        assert "\n" not in str(caught.value)
        assert name in str(caught.value)
    large = packed(tmp_path / "large.npz", ("x.npy", npy(np.random.default_rng(0).normal(size=2000))))
    with pytest.raises(UserError, match="unpacks to 0 MiB, wanted at most 0; split it"):
        read_npz(large, max_bytes=16000)


def test_objects_are_left_to_a_function_that_executes_nothing(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=np.array([{}], dtype=object), y=np.arange(2))
    assert list_npz(tmp_path / "a.npz") == ("x", "y")
    arrays = read_npz(tmp_path / "a.npz", objects=lambda data: ("seen", data[:1]))
    assert arrays["x"].item() == ("seen", b"\x80")
    assert arrays["y"].tolist() == [0, 1]
    np.save(tmp_path / "a.npy", np.array([{}], dtype=object))
    assert read_npy(tmp_path / "a.npy", objects=len).item() > 100
    (tmp_path / "text.npz").write_text("no zip")
    with pytest.raises(UserError, match=r"text.npz is not an .npz archive"):
        list_npz(tmp_path / "text.npz")


def test_what_is_not_asked_for_may_hold_anything(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=np.arange(3), y=np.array([{}], dtype=object))
    assert list(read_npz(tmp_path / "a.npz", only=("x", "z"))) == ["x"]
    packed(tmp_path / "b.npz", ("folder/", b""), ("../x.npy", npy(np.arange(3))))
    assert read_npz(tmp_path / "b.npz")["../x"].tolist() == [0, 1, 2]
    assert not (tmp_path.parent / "x.npy").exists()


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3), np.asfortranarray(np.arange(6, dtype=">i2").reshape(2, 3)), np.array("neutral"),
        np.array(b"male"), np.zeros((0, 3)), np.array(2.5), np.array([True, False]), np.array(["a", "bc"]),
        np.array(1 + 2j), np.array("2020-01-01", "M8[D]"), np.array(""),
    ],
    ids=lambda array: f"{array.dtype}{list(array.shape)}",
)  # fmt: skip
def test_arrays_come_back_as_they_were(array: np.ndarray, tmp_path: Path) -> None:
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", x=array)
        back = read_npz(tmp_path / "a.npz")["x"]
        assert back.dtype == array.dtype
        assert back.shape == array.shape
        assert back.tobytes() == array.tobytes()
    np.save(tmp_path / "a.npy", array)
    back = read_npy(tmp_path / "a.npy")
    assert back.dtype == array.dtype
    assert back.shape == array.shape
    assert back.tobytes() == array.tobytes()
    assert back.flags.writeable


def test_npy_files_that_are_none_end_in_one_line(tmp_path: Path) -> None:
    good = npy(np.arange(3))
    contents = {
        "cut": good[:-1], "empty": b"", "text": b"poses", "objects": npy(np.zeros(0), descr="|O"),
        "longer": good + b"0", "absurd": npy(np.arange(3), shape=(2**62,)),
    }  # fmt: skip
    wrong = {
        "cut": "damaged", "empty": "not an .npy", "text": "not an .npy", "objects": "never executed", "longer": "damaged",
        "absurd": "damaged", "missing": "no pose file at",
    }  # fmt: skip
    for name, content in contents.items():
        (tmp_path / f"{name}.npy").write_bytes(content)
    for name, message in wrong.items():
        with pytest.raises(UserError, match=message) as caught:
            read_npy(tmp_path / f"{name}.npy", "pose file")
        assert "\n" not in str(caught.value)
        assert name in str(caught.value)
    with pytest.raises(UserError, match="has 0 MiB, wanted at most 0"):
        read_npy(tmp_path / "longer.npy", max_bytes=8)
    with pytest.raises(UserError, match="is a folder"):
        read_npy(tmp_path)


@pytest.mark.parametrize("number", [errno.EACCES, errno.EMFILE, errno.EIO, errno.ENOMEM])
def test_errors_of_the_system_are_not_damage(number, tmp_path, monkeypatch):
    np.savez(tmp_path / "a.npz", x=np.arange(3))
    np.save(tmp_path / "a.npy", np.arange(3))
    torch.save({"x": 1}, tmp_path / "a.pt")

    def failing(*_, **__):
        raise OSError(number, os.strerror(number))  # as of a read, without a name

    monkeypatch.setattr(Path, "open", failing)
    readers = ((read_npz, "a.npz"), (list_npz, "a.npz"), (read_npy, "a.npy"), (read_torch, "a.pt"), (read_plain_torch, "a.pt"))
    for read, name in readers:
        with pytest.raises(OSError, match=os.strerror(number)) as caught:
            read(tmp_path / name)
        assert caught.value.filename == str(tmp_path / name)
        assert "damaged" not in str(user_message(caught.value))


def test_too_little_memory_is_not_damage(tmp_path, monkeypatch):
    np.savez(tmp_path / "a.npz", x=np.arange(3))
    monkeypatch.setattr(array_files, "_read_array", lambda *_: bytearray(2**62))
    with pytest.raises(MemoryError, match=r"not enough memory to read .*a\.npz; close other programs"):
        read_npz(tmp_path / "a.npz")


def test_a_mapped_array_is_that_of_its_file(tmp_path):
    array = np.arange(24, dtype=np.uint16).reshape(2, 3, 4)
    np.save(tmp_path / "a.npy", array)
    got = map_npy(tmp_path / "a.npy", (2, 3, 4), np.uint16)
    np.testing.assert_array_equal(got, array)
    assert not got.flags.writeable
    np.save(tmp_path / "none.npy", array[:0])
    assert map_npy(tmp_path / "none.npy", (0, 3, 4), np.uint16).shape == (0, 3, 4)
    for shape, dtype, message in (((2, 3, 5), np.uint16, "wanted uint16"), ((2, 3, 4), np.int16, "wanted int16")):
        with pytest.raises(UserError, match=message):
            map_npy(tmp_path / "a.npy", shape, dtype)
    content = (tmp_path / "a.npy").read_bytes()
    for damaged in (content[:-1], content + b"x", b"", content.replace(b"(2, 3, 4)", b"(2, 3, 9)")):
        (tmp_path / "a.npy").write_bytes(damaged)
        with pytest.raises(UserError, match=r"a\.npy is not an \.npy file, or is truncated"):
            map_npy(tmp_path / "a.npy", (2, 3, 4), np.uint16)
