"""Files of PyTorch and joblib: the arrays that PyTorch reads, other classes rejected by name, and nothing executed."""

from __future__ import annotations

import logging
import os
import pickle
import re
import struct
import tracemalloc
import zlib
from collections import OrderedDict
from enum import Enum
from pathlib import Path

import numpy as np
import pytest
import torch
from estimates import rezipped, saved
from fuzz_motion_targets import like_joblib

from snarfcli.errors import UserError
from snarfcli.formats.pickle_tree import Unknown
from snarfcli.formats.pickles import read_estimate
from snarfcli.formats.torch_files import read_torch

X = torch.arange(24.0).reshape(4, 6) / 7


def tensors():
    return {
        "transposed": X.t(), "half": X.half(), "bfloat16": X.bfloat16(), "double": X.double()[1:, ::2], "long": torch.arange(3),
        "mask": X > 1, "empty": torch.zeros(0, 3), "scalar": torch.tensor(2.5), "expanded": torch.ones(1).expand(5),
        "parameter": torch.nn.Parameter(X), "bytes": torch.arange(3, dtype=torch.uint8),
    }  # fmt: skip


def check(got):
    for name, tensor in tensors().items():
        wanted = tensor.detach().float() if name == "bfloat16" else tensor.detach()
        np.testing.assert_array_equal(got[name], wanted.numpy(), err_msg=name)
        assert got[name].flags.owndata or got[name].base.flags.owndata
    assert got["more"]["text"] == "a"
    np.testing.assert_array_equal(got["more"]["list"][1], X.numpy())
    assert got["size"] == (4, 6)


@pytest.mark.parametrize("is_zip", [True, False])
def test_tensors_of_every_type_and_layout(tmp_path, is_zip):
    content = {**tensors(), "more": OrderedDict(text="a", list=[X, X]), "size": X.shape}
    (tmp_path / "a.pt").write_bytes(saved(content, is_zip=is_zip))
    check(read_torch(tmp_path / "a.pt"))


@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_tensors_in_plain_pickles(tmp_path, protocol):
    content = {**tensors(), "more": {"text": "a", "list": [X, X]}, "size": X.shape}
    for data in (pickle.dumps(content, protocol), zlib.compress(pickle.dumps(content, protocol))):
        (tmp_path / "a.pkl").write_bytes(data)
        check(read_estimate(tmp_path / "a.pkl"))


def test_what_joblib_writes(tmp_path):
    array = np.arange(6.0).reshape(2, 3)
    path = tmp_path / "a.pkl"
    for data in (like_joblib(array), zlib.compress(like_joblib(array))):
        path.write_bytes(data)
        np.testing.assert_array_equal(read_estimate(path)[0]["poses"], array)
    joblib = pytest.importorskip("joblib", reason="joblib is only an option of the project")
    for compress in (0, 3, ("gzip", 3)):
        joblib.dump({7: {"pose": array, "turned": np.asfortranarray(array), "count": np.arange(3)}}, path, compress=compress)
        got = read_estimate(path)[7]
        np.testing.assert_array_equal(got["pose"], array)
        np.testing.assert_array_equal(got["turned"], array)
        np.testing.assert_array_equal(got["count"], [0, 1, 2])


class Color(Enum):
    RED = 1


class Settings(dict):
    """A dictionary of another class, as `easydict` and `omegaconf` have them."""


class Runs:
    def __reduce__(self):
        return os.system, ("touch ran",)


@pytest.mark.parametrize("is_zip", [True, False])
def test_nothing_is_executed(tmp_path, monkeypatch, caplog, is_zip):
    monkeypatch.chdir(tmp_path)
    content = {"a": X, "b": Runs(), "c": Path(), "d": [open, torch.nn.Linear(2, 2)], "e": Settings(k=1), "f": Color.RED}
    (tmp_path / "a.pt").write_bytes(saved(content, is_zip=is_zip))
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
    for read, name in ((read_torch, "a.pt"), (read_estimate, "a.pkl")):
        caplog.clear()
        with caplog.at_level(logging.INFO, "snarfcli"):
            got = read(tmp_path / name)
        np.testing.assert_array_equal(got["a"], X.numpy())
        places = [got["b"], got["c"], *got["d"], got["e"], got["f"]]
        assert all(isinstance(place, Unknown) for place in places)
        assert got["b"].path in ("posix.system", "nt.system")
        assert f"{name}: objects of unknown classes were left out, nothing was executed: " in caplog.text
        assert ".system, pathlib" in caplog.text
    assert not (tmp_path / "ran").exists()


def changed(name, change):
    return rezipped(saved({"a": X}), lambda member, data: change(data) if member.endswith(name) else data)


def resized(**sizes):
    """Return a file whose tensor has another size, stride or first value than its storage allows."""
    values = {"first": 0, "size": (4, 6), "stride": (6, 1), **sizes}
    old = b"K\x00K\x04K\x06\x86q\x08K\x06K\x01\x86"
    new = b"".join(pickle.dumps(values[key], 2)[2:-1] for key in ("first", "size", "stride"))
    return changed("data.pkl", lambda data: re.sub(re.escape(old), lambda _: new, data))


CASES = {
    "text": (b"hello", "is not a file of PyTorch, or is cut off"),
    "cut off": (saved({"a": X})[:-50], "is not a file of PyTorch, or is cut off"),
    "cut off, old": (saved({"a": X}, is_zip=False)[:-50], "storages that do not fit its tensors"),
    "a zip of something else": (rezipped(saved({}), lambda _name, _data: None), "has no data.pkl"),
    "no storage": (changed("data/0", lambda _: None), "lacks its part data/0"),
    "short storage": (changed("data/0", lambda data: data[:-4]), "larger than its storage"),
    "first value outside": (resized(first=1), "larger than its storage"),
    "huge": (resized(size=(2**20, 2**19), stride=(0, 0)), "far larger when read than the file"),
    "negative stride": (resized(stride=(-6, 1)), "unknown form"),
    "negative size": (resized(size=(-4, 6)), "unknown form"),
    "no sizes": (resized(size=4), "unknown form"),
    "other sizes": (resized(size=(24,)), "unknown form"),
    "many empty rows": (resized(size=(2**39, 2**39, 0), stride=(1, 1, 1)), "unknown form"),
    "complex": (saved({"a": X.to(torch.complex64)}), "tensors of the type torch.ComplexFloatStorage, which motions"),
    "persistent in a pickle": (None, "refers to an object outside the file"),
}


@pytest.mark.parametrize("case", CASES)
def test_damage_and_bombs_end_in_one_line(case, tmp_path):
    data, message = CASES[case]
    (tmp_path / "a.pt").write_bytes(data or b"\x80\x02U\x01aQ.")
    tracemalloc.start()
    try:
        with pytest.raises(UserError) as caught:
            (read_estimate if data is None else read_torch)(tmp_path / "a.pt", "pose file")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"pose file {tmp_path / 'a.pt'} ")
    assert str(caught.value).isprintable()
    assert peak < 2**26


def test_sizes_fit_the_byte_order_of_the_file(tmp_path):
    swapped = rezipped(
        saved({"a": X}),
        lambda name, data: b"big" if name.endswith("byteorder") else data if ".pkl" in name or "data/0" not in name
        else struct.pack(">24f", *struct.unpack("<24f", data)),
    )  # fmt: skip
    (tmp_path / "a.pt").write_bytes(swapped)
    np.testing.assert_array_equal(read_torch(tmp_path / "a.pt")["a"], X.numpy())


def test_compressed_bombs_and_cut_files(tmp_path):
    path = tmp_path / "a.pkl"
    bomb = zlib.compressobj(9)
    zeros = bytes(2**20)
    path.write_bytes(b"".join(bomb.compress(zeros) for _ in range(193)) + bomb.flush())
    with pytest.raises(UserError, match=r"unpacks to over 192 MiB, or is cut off"):
        read_estimate(path)
    path.write_bytes(zlib.compress(pickle.dumps({"a": 1}))[:-6])
    with pytest.raises(UserError, match="cut off"):
        read_estimate(path)
    path.write_bytes(zlib.compress(b"x" * 100)[:2] + b"\xff" * 30)
    with pytest.raises(UserError, match="is compressed, and damaged"):
        read_estimate(path)


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(UserError, match="no pose file at"):
        read_torch(tmp_path / "none.pt", "pose file")
    with pytest.raises(UserError, match="is a folder"):
        read_torch(tmp_path, "pose file")
