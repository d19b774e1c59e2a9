"""Pickles: plain data is read as Python reads it, other classes are rejected by name, and nothing is executed."""

from __future__ import annotations

import os
import pickle
import random
import re
import struct
import tracemalloc
from collections import OrderedDict, defaultdict
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

from snarfcli.errors import UserError
from snarfcli.formats.pickles import read_pickle

GOLDEN = Path(__file__).parents[1] / "bodies" / "golden"
PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)


def read(data: bytes, folder: Path):
    path = folder / "model.pkl"
    path.write_bytes(data)
    return read_pickle(path, "body")


def refusal(data: bytes, folder: Path) -> str:
    with pytest.raises(UserError) as caught:
        read(data, folder)
    message = str(caught.value)
    assert message.startswith(f"body {folder / 'model.pkl'} ")
    assert message.isprintable()
    assert len(message) < 500
    return message


def plain() -> dict:
    shared = [1, 2]
    return {
        "text": "Zürich ☃", "old": "abc", "bytes": b"\x00\xff'\\n\"", "none": b"", "empty": "",
        "numbers": [0, 1, -1, 255, 256, 65536, -(2**31), 2**31, 2**63 - 1, -(2**63), 2**64 - 1, 0.1, float("inf"), -1e-300],
        "flags": (True, False, None), "tuples": ((), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4)),
        "shared": [shared, shared], "set": {1, "a"}, "frozen": frozenset([2.5]), 7: {"deep": [[[{}]]]},
        "ordered": OrderedDict([("b", 1), ("a", [2])]), "array": np.float32(2.5), "truth": np.bool_(True),
    }  # fmt: skip


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_plain_data_of_python_3(protocol, tmp_path):
    got = read(pickle.dumps(plain(), protocol), tmp_path)
    assert got == plain()
    assert list(got["ordered"]) == ["b", "a"]
    assert type(got["array"]) is float
    assert type(got["flags"][0]) is bool
    assert read(pickle.dumps(1.5, protocol) + b"more", tmp_path) == 1.5


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_arrays(protocol, tmp_path):
    rng = np.random.default_rng(0)
    arrays = [rng.integers(0, 100, (2, 3)).astype(code) for code in "?bBhHiIlLqQefdFD"]
    arrays += [array.astype(array.dtype.newbyteorder(">")) for array in arrays]
    arrays += [np.zeros((0, 3)), np.array(5), np.array(["a", "bcd"]), np.array([b"x", b"yz"]), np.arange(20)[::3]]
    arrays += [rng.random((3, 4)).T, np.asfortranarray(rng.random((4, 5)))]
    for got, wanted in zip(read(pickle.dumps(arrays, protocol), tmp_path), arrays, strict=True):
        assert got.shape == wanted.shape
        assert got.dtype == wanted.dtype.newbyteorder("=")
        np.testing.assert_array_equal(got, wanted)
        assert got.flags.aligned
        assert got.flags.writeable
        assert got.dtype.isnative
    assert read(pickle.dumps(np.array([1, "a", None, [2]], object), protocol), tmp_path) == [1, "a", None, [2]]


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("form", ["csc", "csr", "coo"])
def test_sparse_matrices(protocol, form, tmp_path):
    dense = np.zeros((5, 7))
    dense[[0, 2, 4, 4], [1, 6, 0, 3]] = [1.5, -2, 3, 4]
    for kind in ("matrix", "array"):
        matrix = getattr(scipy.sparse, f"{form}_{kind}")(dense)
        got = read(pickle.dumps(matrix, protocol), tmp_path)
        assert got.shape == dense.shape
        assert got.toarray().dtype == dense.dtype
        np.testing.assert_array_equal(got.toarray(), dense)


def test_entries_of_a_sparse_matrix_at_one_place_are_added(tmp_path):
    matrix = scipy.sparse.coo_matrix((np.array([1.0, 2, 4]), (np.array([1, 0, 1]), np.array([2, 0, 2]))), (2, 3))
    np.testing.assert_array_equal(read(pickle.dumps(matrix, 2), tmp_path).toarray(), [[2, 0, 0], [0, 0, 5]])


@pytest.mark.parametrize("protocol", [0, 1, 2])
def test_files_of_python_2_and_chumpy(protocol):
    got = read_pickle(GOLDEN / f"python2_body_{protocol}.pkl")
    np.testing.assert_array_equal(got["shapedirs"], (np.arange(72).reshape(6, 3, 4) / 100)[:, :, :2])
    np.testing.assert_array_equal(got["posedirs"], np.arange(162).reshape(6, 3, 9) / 1000)
    np.testing.assert_array_equal(got["weights"], [[1, 0], [1, 0], [0, 1], [1, 0], [1, 0], [1, 0]])
    np.testing.assert_array_equal(got["J_regressor"].toarray()[0], [0, 0, 0, 0.5, 0.25, 0.25])
    np.testing.assert_array_equal(got["J_regressor_prior"].toarray(), np.eye(2, 6))
    np.testing.assert_array_equal(got["kintree_table"], np.array([[2**32 - 1, 0], [0, 1]], np.uint32))
    assert got["v_template"][2].tolist() == [0, 1, 0]
    assert got["bs_type"] == "lrotmin"
    assert got["pose_training_info"] == {"scans": 3.0, "ids": {1, 2}}


def test_strings_of_python_2_are_latin1(tmp_path):
    assert read(b"U\x04Z\xfcri.", tmp_path) == "Züri"
    assert read(b"S'Z\\xfcri\\n'\np0\n.", tmp_path) == "Züri\n"
    assert read(b"(dp0\nS'00032'\np1\nS'male'\np2\ns.", tmp_path) == {"00032": "male"}
    assert read(b"(lp0\nI5\naL-3L\naI01\naF0.5\naV\\u2603\na.", tmp_path) == [5, -3, True, 0.5, "\u2603"]


class Runs:
    def __init__(self, function, *args) -> None:
        self.what = function, args

    def __reduce__(self):
        return self.what


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(
    ("made", "name"),
    [
        (Runs(os.system, "touch ran"), "(posix|nt).system"),
        (Runs(eval, "open('ran', 'w')"), "(__builtin__|builtins).eval"),
        (Runs(getattr, np.ndarray, "tofile"), "(__builtin__|builtins).getattr"),
        (Runs(np.load, "x"), r"numpy[\w.]*.load"),
        (Decimal(1), "decimal.Decimal"),
        (defaultdict(list), "collections.defaultdict"),
        (Path(), "pathlib"),
        (Runs(scipy.sparse.dia_matrix, 1), "scipy.sparse._dia.dia_matrix"),
        (open, r"\w+.open"),
    ],
)
def test_other_classes_are_refused_by_name(made, name, protocol, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = refusal(pickle.dumps({"v_template": np.eye(3), "x": [made]}, protocol), tmp_path)
    assert re.search(f"asks for {name}", message), message
    assert [path.name for path in tmp_path.iterdir()] == ["model.pkl"]


def test_names_found_through_others_are_refused(tmp_path):
    # Python's unpickler follows the dots in a name from object to object.
    message = refusal(b"\x80\x04\x8c\x15numpy.core.multiarray\x8c\x09os.system\x93.", tmp_path)
    assert "asks for numpy.core.multiarray.os.system" in message
    assert "builtins.getattr" in refusal(b"\x80\x02cbuiltins\ngetattr\n.", tmp_path)
    assert "chumpy.ch_ops.add" in refusal(b"\x80\x02cchumpy.ch_ops\nadd\n)\x81}b.", tmp_path)
    assert "old-style instance of chumpy.ch.Ch" in refusal(b"(ichumpy.ch\nCh\n.", tmp_path)
    message = refusal(b"\x80\x04\x8c\x06os\n\x1b[2\x8c\xff" + b"\xe2\x98\x83" * 85 + b"\x93.", tmp_path)
    assert r"asks for os\n\x1b[2.\u2603" in message


# --- attacks on the reader ----------------------------------------------------------------------------------------------------

ARRAY = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85U\x01btR"
F8 = b"cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"


def array(shape: bytes, dtype: bytes = F8, data: bytes = b"U\x10" + bytes(16), more: bytes = b"") -> bytes:
    return b"\x80\x02" + ARRAY + b"(K\x01" + shape + dtype + b"\x89" + data + more + b"tb."


CASES = {
    "nothing": (b"", "not a pickle"),
    "text": (b"hello there", "not a pickle"),
    "cut off": (pickle.dumps(plain(), 2)[:-9], "cut off"),
    "no stop": (b"K\x01", "cut off"),
    "empty stack": (b".", "damaged"),
    "mark missing": (b"]e.", "damaged"),
    "mark not crossed": (b"K\x01(0000.", "damaged"),
    "memo from the future": (b"h\x05.", "damaged"),
    "huge bytes": (b"\x8e" + struct.pack("<Q", 2**62) + b"x.", "cut off"),
    "huge text": (b"\x8d" + struct.pack("<Q", 2**63) + b"x.", "cut off"),
    "huge bytearray": (b"\x96" + struct.pack("<Q", 2**40) + b"x.", "cut off"),
    "negative length": (b"T\xff\xff\xff\xff.", "damaged"),
    "long number": (b"L" + b"9" * 1_000_000 + b"L\n.", "damaged"),
    "long integer": (b"I" + b"9" * 90 + b"\n.", "more than 64 bits"),
    "long bytes number": (b"\x8b" + struct.pack("<I", 1_000_000) + bytes(1_000_000) + b".", "more than 64 bits"),
    "extension": (b"\x82\x01.", "registered number"),
    "persistent": (b"Pabc\n.", "outside the file"),
    "old-style": (b"(cchumpy.ch\nCh\no.", "old-style"),
    "buffer": (b"\x80\x05\x97.", "outside the file"),
    "protocol": (b"\x80\x09N.", "protocol"),
    "build on a list": (b"]}b.", "damaged"),
    "build twice": (b"cchumpy.ch\nCh\n)\x81}b}b.", "damaged"),
    "call of a list": (b"])R.", "damaged"),
    "keywords": (b"\x80\x04ccollections\nOrderedDict\n)}K\x01K\x02s\x92.", "keyword"),
    "class as value": (b"cnumpy\nndarray\n.", "class numpy.ndarray as a value"),
    "no state": (b"cchumpy.ch\nCh\n)\x81.", "unknown form"),
    "items on chumpy": (b"cchumpy.ch\nCh\n)\x81K\x01K\x02s}U\x01xK\x01sb.", "unknown form"),
    "list in itself": (b"]q\x00h\x00a.", "contains itself"),
    "dict in itself": (b"}q\x00K\x01h\x00s.", "contains itself"),
    "chumpy in itself": (b"cchumpy.ch\nCh\n)\x81q\x00}U\x01xh\x00sb.", "contains itself"),
    "nested lists": (b"]" * 100_000 + b"a" * 99_999 + b".", "64 levels"),
    "nested tuples": (b")" + b"\x85" * 200_000 + b".", "64 levels"),
    "nested dicts": (b"}" + b"K\x01}" * 100_000 + b"s" * 100_000 + b".", "64 levels"),
    "nested tuple as key": (b"}" + b")" + b"\x85" * 200_000 + b"K\x01s.", "neither text nor a number"),
    "nested tuple in a set": (b"\x8f()" + b"\x85" * 200_000 + b"\x90.", "neither text nor a number"),
    "nested chumpy": (b"cchumpy.ch\nCh\n)\x81}U\x01x" * 5000 + b"K\x01" + b"sb" * 5000 + b".", "64 levels"),
    "doubling lists": (b"]q\x00" + b"0](h\x00h\x00eq\x00" * 60 + b".", "10,000,000 values"),
    "many steps": (b"N0" * 300_000 + b"N.", "500,000 steps"),
    "negative size": (array(b"J\xff\xff\xff\xff\x85"), "valid shape"),
    "size as text": (array(b"U\x012\x85"), "valid shape"),
    "huge array": (array(b"J\xff\xff\xff\x7f\x85"), "16 bytes for an array of shape [2147483647]"),
    "huge empty array": (array(b"K\x00\x8a\x05\0\0\0\0\x10\x8a\x05\0\0\0\0\x10\x87", data=b"U\x00"), "valid shape"),
    "many dimensions": (array(b"(" + b"K\x01" * 40 + b"t"), "valid shape"),
    "records": (array(b"K\x02\x85", F8.replace(b"NNN", b"N)N")), "records"),
    "void": (array(b"K\x02\x85", F8.replace(b"f8", b"V8")), "wanted numbers or text, got V8"),
    "long type": (array(b"K\x02\x85", F8.replace(b"U\x02f8", b"X" + struct.pack("<I", 10**6) + b"f8" * 500_000)), "f8f8"),
    "wide text": (array(b"K\x01\x85", F8.replace(b"U\x02f8", b"U\x09U99999999")), "wanted numbers or text"),
    "no text": (array(b"K\x01\x85", F8.replace(b"f8", b"U4"), b"U\x10" + b"\xff" * 16), "cannot be decoded"),
    "no bytes": (array(b"K\x02\x85", data=b"K\x01"), "unknown form"),
    "objects": (array(b"K\x09\x85", F8.replace(b"f8", b"O8"), b"](K\x01K\x02e"), "another number of objects"),
    "objects in bytes": (array(b"K\x02\x85", F8.replace(b"f8", b"O8")), "another number of objects"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_bombs_end_in_one_line(case, tmp_path):
    data, message = CASES[case]
    tracemalloc.start()
    try:
        error = refusal(data, tmp_path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert message in error
    assert peak < 2**29


def test_memo_numbers_cost_nothing(tmp_path):
    tracemalloc.start()
    assert read(b"K\x05r\xff\xff\xff\xff0j\xff\xff\xff\xff.", tmp_path) == 5
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_one_payload_shared_by_many_arrays_does_not_grow(tmp_path):
    payload = b"T" + struct.pack("<i", 8_000_000) + bytes(8_000_000) + b"q\x010"
    one = array(b"J" + struct.pack("<i", 1_000_000) + b"\x85", data=b"h\x01")[2:-1]
    assert "far larger" in refusal(payload + b"](" + one * 1000 + b"e.", tmp_path)
    assert len(read(payload + b"](" + one * 3 + b"e.", tmp_path)) == 3


def test_sparse_matrices_that_would_write_elsewhere(tmp_path):
    for key, value in {
        "indices": np.array([0, 9]), "indptr": np.array([0, 2, 1]), "data": np.ones(3), "_shape": (3, 2**40),
        "row": np.array([0, -1]), "col": [0, 1],
    }.items():  # fmt: skip
        for form in ("csc", "coo"):
            matrix = getattr(scipy.sparse, f"{form}_matrix")(np.array([[1, 0], [0, 0], [0, 2.0]]))
            state = matrix.__dict__
            if key not in state and not (form == "coo" and key in ("row", "col")):
                continue
            state[key] = value
            if form == "coo":
                state.pop("coords", None)
                state.setdefault("row", np.array([0, 2])), state.setdefault("col", np.array([0, 1]))
            message = refusal(b"\x80\x02cscipy.sparse." + form.encode() + b"\n" + form.encode() + b"_matrix\n)\x81"
                              + pickle.dumps(state, 2)[2:-1] + b"b.", tmp_path)  # fmt: skip
            assert "do not fit together" in message


def test_chumpy_selections_that_do_not_fit(tmp_path):
    def selection(a, idxs, shape) -> bytes:
        state = pickle.dumps({"a": a, "idxs": idxs, "preferred_shape": shape}, 2)[2:-1]
        return b"\x80\x02cchumpy.reordering\nSelect\n)\x81" + state + b"b."

    values = np.arange(6.0).reshape(2, 3)
    assert read(selection(values, np.array([5, 0]), (2, 1)), tmp_path).tolist() == [[5], [0]]
    for case in [(values, np.array([6]), (1,)), (values, np.array([-1]), (1,)), (values, np.array([1]), (2**40, 2**40)),
                 (values, np.array([1.0]), (1,)), (None, np.array([1]), (1,)), (values, np.array([1]), ("1",))]:  # fmt: skip
        assert "damaged" in refusal(selection(*case), tmp_path)


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(UserError, match="no body at"):
        read_pickle(tmp_path / "none.pkl", "body")
    with pytest.raises(UserError, match="is a folder"):
        read_pickle(tmp_path)


def test_random_steps_are_read_or_refused(tmp_path):
    rng = random.Random(0)
    codes = b"(.0125BCFIJKLMNPQRSTUVX]abcdeghijlopqrstu}G)" + bytes(range(0x80, 0x99))
    for _ in range(3000):
        body = bytes(rng.choice(codes) if rng.random() < 0.8 else rng.randrange(256) for _ in range(rng.randint(1, 60)))
        message = "model.pkl"
        try:
            read(body + b".", tmp_path)
        except UserError as error:
            message = str(error)
        assert "model.pkl" in message
        assert message.isprintable()
