"""Damage to pickles that targets their reader: other opcodes, sizes and memo numbers, and bodies that do not fit."""

from __future__ import annotations

import pickle
import pickletools
import random
import struct

import numpy as np
import scipy.sparse
from smpl_files import octahedron, pickled

__all__ = ["damaged", "damaged_arrays", "damaged_body"]

_INTEGERS = (0, 1, 2, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)
_CODES = bytes(opcode.code.encode("latin1")[0] for opcode in pickletools.opcodes)
_PIECES = (
    b"cposix\nsystem\n", b"c__builtin__\neval\n", b"cnumpy\nndarray\n", b"cnumpy\ndtype\n", b"cchumpy.ch\nCh\n",
    b"cchumpy.reordering\nSelect\n", b"cscipy.sparse.csc\ncsc_matrix\n", b"c__builtin__\nset\n", b"ccollections\nOrderedDict\n",
    b"c_codecs\nencode\n", b"ccopy_reg\n_reconstructor\n", b"cnumpy.core.multiarray\nscalar\n", b"h\x00", b"h\x01", b"h\x05",
    b"(t", b"(l", b"(d", b"}b", b")R", b")\x81", b"Nb", b"2\x86", b"r\xff\xff\xff\xff", b"\x8e" + b"\xff" * 8, b"K\x01K\x02s",
    b"]" * 100, b"\x85" * 100, b"2a", b"h\x00a", b"U\x02f8", b"U\x02O8", b"U\x03U99", b"I99999999999\n", b"Vx\\ud800\n", b"N",
    b"0", b"ctorch._utils\n_rebuild_tensor_v2\n", b"ctorch\nBFloat16Storage\n", b"ctorch.storage\n_load_from_bytes\n", b"Q",
    b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n", b"ccollections\ndefaultdict\n", b"c__builtin__\ndict\n",
)  # fmt: skip


def damaged(rng: random.Random, content: bytes) -> bytes:
    """Change a pickle between its opcodes, so that most of it stays valid."""
    for _ in range(rng.choice([1, 1, 2, 5])):
        content = _changed(rng, content)
    return content


def _changed(rng: random.Random, content: bytes) -> bytes:
    places = []
    try:
        for _, _, place in pickletools.genops(content):
            places.append(place)
    except Exception:  # damaged already: up to here
        pass
    if len(places) < 3:
        return content
    first, second = sorted(rng.sample(range(len(places)), 2))
    begin, end, kind = places[first], places[second], rng.randrange(7)
    after = places[first + 1]
    if kind == 0:  # another opcode for the same operand
        return content[:begin] + bytes([rng.choice(_CODES)]) + content[begin + 1 :]
    if kind == 1:
        return content[:begin] + rng.choice(_PIECES) + content[begin:]
    if kind == 2:
        return content[:begin] + rng.choice(_PIECES) + content[after:]
    if kind == 3:
        return content[:begin] + content[after:]
    if kind == 4:  # one step somewhere else
        return content[:end] + content[begin:after] + content[end:]
    if kind == 5:  # many times
        return content[:begin] + content[begin:after] * rng.choice([2, 10, 300]) + content[after:]
    integer = rng.choice(_INTEGERS)
    number = rng.choice([struct.pack("<Q", integer), struct.pack("<I", integer % 2**32), b"%d\n" % integer])
    return content[: begin + 1] + number[: max(1, after - begin - 1)] + content[after:]


def damaged_body(rng: random.Random, content: bytes) -> bytes:
    """Return a damaged pickle or, half of the time, a valid pickle of a body with wrong arrays."""
    if rng.random() < 0.5:
        return damaged(rng, content)
    arrays = damaged_arrays(rng, octahedron())
    if rng.random() < 0.3:
        form = rng.choice([scipy.sparse.csc_matrix, scipy.sparse.csr_matrix, scipy.sparse.coo_matrix])
        arrays["J_regressor"] = form(np.ones(rng.choice([(2, 6), (6, 2), (1, 1), (3, 6)])))
    if rng.random() < 0.2:
        return pickle.dumps(arrays, rng.randrange(6))
    keys = [key for key in ("shapedirs", "weights", "posedirs", "f") if isinstance(arrays.get(key), np.ndarray)]
    return pickled(arrays, chumpy=tuple(rng.sample(keys, rng.randint(0, len(keys)))))


def damaged_arrays(rng: random.Random, arrays: dict) -> dict:
    """Change one to three arrays of a body: type, shape, values, or kind."""
    arrays = dict(arrays)
    for key in rng.sample(sorted(arrays), rng.choice([1, 1, 2, 3])):
        array = arrays[key]
        kind = rng.randrange(8)
        if kind == 0:
            del arrays[key]
        elif kind == 1 and array.dtype.kind != "U":
            arrays[key] = array.astype(rng.choice(["i1", "u8", "f2", "f4", ">f8", "?", "c16", "U5", "S3", "i8"]))
        elif kind == 2:
            arrays[key] = array[tuple(slice(0, rng.randint(0, length)) for length in array.shape)]
        elif kind == 3:
            arrays[key] = np.resize(array, [rng.randint(0, 7) for _ in range(rng.randint(0, 4))])
        elif kind == 4 and array.size and array.dtype.kind != "U":
            array = array.astype(rng.choice(["f8", "f4", "i8"]))
            values = (-1, 7, 2**62, -(2**63)) if array.dtype.kind == "i" else (np.nan, np.inf, -1, 1e300, 2**32 - 1, 5, 0.5)
            with np.errstate(over="ignore"):
                array.reshape(-1)[rng.randrange(array.size)] = rng.choice(values)
            arrays[key] = array
        elif kind == 5:
            arrays[key] = np.array(rng.choice(["x", 1.5, 7, [[1]], True]))
        elif kind == 6:
            arrays[key] = array.T
        else:
            arrays[key] = np.concatenate([array, array]) if array.ndim else array
    return arrays
