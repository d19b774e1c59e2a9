"""Kinds of damage for `fuzzing`: each takes a random generator, a file's bytes and those of another seed, and returns bytes."""

from __future__ import annotations

import random
import re
import struct

__all__ = ["DAMAGES"]

_NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9]{2,}")
_NASTY_NUMBERS = (
    b"0", b"-1", b"-0", b"1", b"2", b"255", b"65535", b"65536", b"2147483647", b"2147483648", b"4294967295", b"4294967296",
    b"9223372036854775807", b"-9223372036854775809", b"18446744073709551616", b"1000000000", b"1000000000000", b"1e9", b"1e38",
    b"1e39", b"1e308", b"1e309", b"-1e309", b"1e-320", b"nan", b"inf", b"-Infinity", b"NaN", b"0x10", b"1_000", b"", b"null",
    b"true", b"[]", b"{}", b'"1"', b"1.5", b"9" * 5000, b"\xd9\xa3", b"-", b"1e", b"0.1.2",
)  # fmt: skip
_NASTY_INTEGERS = (0, 1, 2, 3, 7, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 10**6, 2**24, 2**30, 2**31 - 1, 2**31, 2**32 - 1,
                   2**32, 10**12, 2**48, 2**63 - 1, 2**63, 2**64 - 1)  # fmt: skip
_NASTY_FLOATS = (0.0, -0.0, float("nan"), float("inf"), float("-inf"), 1e-45, 1e30, 3e38, -1.0)


def _span(rng: random.Random, content: bytes, longest: int = 400) -> tuple[int, int]:
    start = rng.randrange(len(content) + 1)
    return start, min(len(content), start + rng.randint(1, rng.choice([1, 4, 16, 64, longest])))


def _truncate(rng: random.Random, content: bytes, other: bytes) -> bytes:
    return content[: rng.randrange(len(content) + 1)]


def _behead(rng: random.Random, content: bytes, other: bytes) -> bytes:
    return content[rng.randint(1, 64) :]


def _flip_bits(rng: random.Random, content: bytes, other: bytes) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.choice([1, 1, 2, 8, 32]) if changed else 0):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _flip_early_bits(rng: random.Random, content: bytes, other: bytes) -> bytes:
    return _flip_bits(rng, content[:96], other) + content[96:]


def _overwrite(rng: random.Random, content: bytes, other: bytes) -> bytes:
    start, stop = _span(rng, content)
    return content[:start] + rng.randbytes(stop - start) + content[stop:]


def _insert(rng: random.Random, content: bytes, other: bytes) -> bytes:
    start, _ = _span(rng, content)
    piece = rng.choice([b"\0", b"\n", b"\r\n", b" ", b"\xff\xfe", b"\xef\xbb\xbf", b"{", b"}", b'"', b"\\u2028", b"\x1b[2J"])
    return content[:start] + (piece * rng.choice([1, 1, 3, 1000]) if rng.random() < 0.5 else rng.randbytes(9)) + content[start:]


def _remove(rng: random.Random, content: bytes, other: bytes) -> bytes:
    start, stop = _span(rng, content)
    return content[:start] + content[stop:]


def _splice(rng: random.Random, content: bytes, other: bytes) -> bytes:
    start, stop = _span(rng, content)
    at, end = _span(rng, other)
    return content[:start] + other[at:end] + content[stop if rng.random() < 0.5 else start :]


def _join(rng: random.Random, content: bytes, other: bytes) -> bytes:
    return content[: rng.randrange(len(content) + 1)] + other[rng.randrange(len(other) + 1) :]


def _repeat(rng: random.Random, content: bytes, other: bytes) -> bytes:
    start, stop = _span(rng, content)
    return content[:stop] + content[start:stop] * rng.choice([1, 2, 10, 1000]) + content[stop:]


def _edit_number(rng: random.Random, content: bytes, other: bytes) -> bytes:
    found = list(_NUMBER.finditer(content))
    for match in sorted(rng.sample(found, min(len(found), rng.choice([1, 1, 2, 4]))), key=lambda m: -m.start()):
        content = content[: match.start()] + rng.choice(_NASTY_NUMBERS) + content[match.end() :]
    return content


def _edit_binary_number(rng: random.Random, content: bytes, other: bytes) -> bytes:
    code, order = rng.choice("BHIQfd"), rng.choice("<>")
    if code in "fd":
        piece = struct.pack(order + code, rng.choice(_NASTY_FLOATS))
    else:
        piece = struct.pack(order + code, rng.choice(_NASTY_INTEGERS) % 2 ** (8 * struct.calcsize(order + code)))
    start = rng.randrange(len(content) + 1)
    start -= start % rng.choice([1, len(piece)])
    return content[:start] + piece + content[start + len(piece) :]


def _edit_lines(rng: random.Random, content: bytes, other: bytes) -> bytes:
    lines = content.split(b"\n")
    line, kind = rng.randrange(len(lines)), rng.randrange(5)
    if kind == 0:
        del lines[line]
    elif kind == 1:
        lines[line:line] = [lines[line]] * rng.choice([1, 2, 500])
    elif kind == 2:
        another = rng.randrange(len(lines))
        lines[line], lines[another] = lines[another], lines[line]
    elif kind == 3:
        words = lines[line].split()
        rng.shuffle(words)
        lines[line] = b" ".join(words)
    else:
        lines[line] = rng.choice(other.split(b"\n"))
    return b"\n".join(lines)


def _swap_words(rng: random.Random, content: bytes, other: bytes) -> bytes:
    found, donors = list(_WORD.finditer(content)), _WORD.findall(other)
    if not found or not donors:
        return content
    match = rng.choice(found)
    return content[: match.start()] + rng.choice(donors) + content[match.end() :]


def _make_up(rng: random.Random, content: bytes, other: bytes) -> bytes:
    return rng.choice([b"", b"\0", b"\n", rng.randbytes(rng.randint(1, 300)), content[:4] + rng.randbytes(200), b"\0" * 3000])


# The last, which leaves nothing of the seed, is the rarest.
DAMAGES = (
    _truncate, _behead, _flip_bits, _flip_early_bits, _overwrite, _insert, _remove, _splice, _join, _repeat, _edit_number,
    _edit_binary_number, _edit_lines, _swap_words,
) * 2 + (_edit_number, _edit_binary_number, _make_up)  # fmt: skip
