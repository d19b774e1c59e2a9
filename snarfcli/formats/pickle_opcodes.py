"""Read a pickle as a tree of plain values, without executing it.

Python's own unpickler calls any function that a pickle names, and trusts the sizes and numbers in it. This one processes the
same opcodes (protocols 0 to 5) but calls nothing: where a pickle asks for an object, the tree has a `Call` that says which one.
Payloads are not copied out of the file's bytes, and the memory of every step is proportional to the size of the step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from snarfcli.formats.pickle_machine import PickleMachine, plain_key
from snarfcli.formats.pickle_tree import PickleError

__all__ = ["read_tree", "read_tree_at"]

# A body or a motion takes some hundred steps, a long list of numbers one step per number. Half a million take about a second.
_MAX_STEPS = 500_000
_STOP = 0x2E


def read_tree(data: bytes, known: Mapping[tuple[str, str], str]) -> Any:
    """Return the content of a pickle that begins at the first byte; see `read_tree_at`."""
    return read_tree_at(data, known, 0)[0]


def read_tree_at(data: bytes, known: Mapping[tuple[str, str], str], start: int) -> tuple[Any, int]:
    """Return the content of a pickle as None, bool, int, float, str, list, tuple, dict, set, `Raw`, `Name` and `Call`.

    Containers may be shared and may contain themselves, as in the pickle. Keys and members of sets are plain values.

    Args:
        data: bytes of the file.
        known: kind of each accepted (module, name), which becomes `Name.kind`; other names raise. With ("", "stored"),
            references to objects outside the pickle become a `Call` of that kind; with ("", "unknown"), other names are
            accepted and have that kind.
        start: first byte of the pickle.

    Returns:
        The content, and the number of the byte after the pickle.

    Raises:
        PickleError: a name is not known, the pickle is damaged, or it asks for more than plain data.
    """
    machine, end = PickleMachine(data, known, start), len(data)
    for _ in range(_MAX_STEPS):
        if machine.at >= end:
            raise machine.damaged()
        code = data[machine.at]
        machine.at += 1
        if code == _STOP:
            return machine.pop(), machine.at
        operation = _OPERATIONS.get(code)
        if operation is None:
            raise machine.damaged()
        operation(machine)
    raise PickleError(f"takes more than {_MAX_STEPS:,} steps to read; models and motions store arrays, which take few")


def _integer_of(line: bytes) -> int:
    return {b"00": False, b"01": True}[line] if line in (b"00", b"01") else int(line)


def _rejected(what: str) -> Callable[[PickleMachine], None]:
    def reject(machine: PickleMachine) -> None:
        raise PickleError(f"refers to {what}, which plain data does not need")

    return reject


_EXTENSION = _rejected("a class by a registered number")
_BUFFER = _rejected("a buffer outside the file")

_OPERATIONS: dict[int, Callable[[PickleMachine], Any]] = {
    ord(code) if isinstance(code, str) else code: operation
    for code, operation in {
        # the stack and the memo
        "(": lambda m: m.marks.append(len(m.stack)),
        "0": lambda m: m.pop() if len(m.stack) > (m.marks[-1] if m.marks else 0) else m.pop_to_mark(),
        "1": lambda m: m.pop_to_mark(),
        "2": lambda m: m.push(m.peek()),
        "p": PickleMachine.put_line,
        "q": lambda m: m.put(m.unpack("<B")),
        "r": lambda m: m.put(m.unpack("<I")),
        0x94: lambda m: m.put(len(m.memo)),
        "g": PickleMachine.get_line,
        "h": lambda m: m.get(m.unpack("<B")),
        "j": lambda m: m.get(m.unpack("<I")),
        # numbers
        "N": lambda m: m.push(None),
        0x88: lambda m: m.push(True),
        0x89: lambda m: m.push(False),
        "I": lambda m: m.push_number_line(_integer_of),
        "L": lambda m: m.push_number_line(lambda line: int(line.removesuffix(b"L"))),
        "F": lambda m: m.push_number_line(float),
        "J": lambda m: m.push(m.unpack("<i")),
        "K": lambda m: m.push(m.unpack("<B")),
        "M": lambda m: m.push(m.unpack("<H")),
        0x8A: lambda m: m.push_long("<B"),
        0x8B: lambda m: m.push_long("<I"),
        "G": lambda m: m.push(m.unpack(">d")),
        # text and bytes
        "S": PickleMachine.push_escaped_string,
        "T": lambda m: m.push_raw("<i", "latin1"),
        "U": lambda m: m.push_raw("<B", "latin1"),
        "V": PickleMachine.push_escaped_text,
        "X": lambda m: m.push_raw("<I", "utf-8"),
        0x8C: lambda m: m.push_raw("<B", "utf-8"),
        0x8D: lambda m: m.push_raw("<Q", "utf-8"),
        "B": lambda m: m.push_raw("<I", None),
        "C": lambda m: m.push_raw("<B", None),
        0x8E: lambda m: m.push_raw("<Q", None),
        0x96: lambda m: m.push_raw("<Q", None),
        # containers
        "]": lambda m: m.push([]),
        "l": lambda m: m.push(m.pop_to_mark()),
        "a": lambda m: m.append([m.pop()]),
        "e": lambda m: m.append(m.pop_to_mark()),
        ")": lambda m: m.push(()),
        "t": lambda m: m.push(tuple(m.pop_to_mark())),
        0x85: lambda m: m.push_tuple(1),
        0x86: lambda m: m.push_tuple(2),
        0x87: lambda m: m.push_tuple(3),
        "}": lambda m: m.push({}),
        "d": lambda m: m.push(m.pairs(m.pop_to_mark())),
        "s": lambda m: m.set_items([m.pop(), m.pop()][::-1]),
        "u": lambda m: m.set_items(m.pop_to_mark()),
        0x8F: lambda m: m.push(set()),
        0x90: lambda m: m.add(m.pop_to_mark()),
        0x91: lambda m: m.push(frozenset(map(plain_key, m.pop_to_mark()))),
        # objects
        "c": lambda m: m.push_name(m.line(), m.line()),
        0x93: PickleMachine.push_stack_name,
        "R": PickleMachine.push_call,
        0x81: PickleMachine.push_call,
        0x92: PickleMachine.push_call_without_keywords,
        "b": PickleMachine.build,
        "i": PickleMachine.reject_instance,
        "o": _rejected("an old-style class"),
        "P": lambda m: m.push_stored(m.line(100)),
        "Q": lambda m: m.push_stored(m.pop()),
        0x82: _EXTENSION,
        0x83: _EXTENSION,
        0x84: _EXTENSION,
        0x97: _BUFFER,
        0x98: _BUFFER,
        # Frames only state how much to read at once.
        0x80: PickleMachine.check_protocol,
        0x95: lambda m: m.take(8),
    }.items()
}
