"""What a pickle says to do, written down as a tree of plain values and nothing done.

Python's own unpickler runs whatever callable a pickle names, and trusts the sizes and numbers that it states. This one walks
the same opcodes (protocols 0 to 5) but calls nothing: where a pickle wants an object made, the tree holds a `Call` that says
which one. Payloads stay where they are in the file's bytes, and every step takes memory in proportion to itself.
"""

from __future__ import annotations

import codecs
import struct
from collections.abc import Callable, Mapping
from typing import Any

from snarfcli.formats.pickle_tree import Call, Name, PickleError, Raw, shown

__all__ = ["read_tree"]

# A body or motion takes some hundred steps, a long list of numbers one step a number. Half a million take about a second.
_MAX_STEPS = 500_000
_NUMBER_LENGTH = 100


def read_tree(data: bytes, known: Mapping[tuple[str, str], str]) -> Any:
    """Return what a pickle describes, as None, bool, int, float, str, list, tuple, dict, set, `Raw`, `Name` and `Call`.

    Containers may be shared and may hold themselves, as in the pickle. Keys and members of sets are plain.

    Args:
        data: the file.
        known: what each (module, name) is taken for, which becomes `Name.kind`; every other name is refused.

    Raises:
        PickleError: a name is not known, the pickle is damaged, or it asks for what no plain data needs.
    """
    return _Machine(data, known).run()


class _Machine:
    def __init__(self, data: bytes, known: Mapping[tuple[str, str], str]) -> None:
        self.data, self.known = data, known
        self.view = memoryview(data)
        self.at = 0
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def run(self) -> Any:
        data, end, operations = self.data, len(self.data), _OPERATIONS
        for _ in range(_MAX_STEPS):
            if self.at >= end:
                raise self.damaged()
            code = data[self.at]
            self.at += 1
            if code == 0x2E:  # STOP
                return self.pop()
            operation = operations.get(code)
            if operation is None:
                raise self.damaged()
            operation(self)
        raise PickleError(f"takes more than {_MAX_STEPS:,} steps to read; models and motions store arrays, which take few")

    def damaged(self) -> PickleError:
        return PickleError(f"is not a pickle, or is damaged or cut off (byte {self.at}); copy or download it again")

    # The bytes after an opcode.

    def take(self, count: int) -> memoryview:
        begin, self.at = self.at, self.at + count
        if count < 0 or self.at > len(self.data):
            raise self.damaged()
        return self.view[begin : self.at]

    def unpack(self, form: str) -> Any:
        return struct.unpack(form, self.take(struct.calcsize(form)))[0]

    def line(self, longest: int | None = None) -> bytes:
        stop = self.data.find(b"\n", self.at, None if longest is None else self.at + longest)
        if stop < 0:
            raise self.damaged()
        begin, self.at = self.at, stop + 1
        return self.data[begin:stop]

    # The stack.

    def push(self, value: Any) -> None:
        self.stack.append(value)

    def pop(self) -> Any:
        if len(self.stack) <= (self.marks[-1] if self.marks else 0):
            raise self.damaged()
        return self.stack.pop()

    def pop_to_mark(self) -> list:
        if not self.marks:
            raise self.damaged()
        mark = self.marks.pop()
        items = self.stack[mark:]
        del self.stack[mark:]
        return items

    def peek(self) -> Any:
        value = self.pop()
        self.stack.append(value)
        return value

    # Operations that more than one opcode has.

    def push_integer(self, value: int) -> None:
        if not -(2**63) <= value < 2**64:
            raise PickleError("holds a number of more than 64 bits")
        self.stack.append(value)

    def push_number_line(self, parse: Callable[[bytes], Any]) -> None:
        line = self.line(_NUMBER_LENGTH)
        try:
            value = parse(line)
        except ValueError:
            raise self.damaged() from None
        if isinstance(value, int):
            self.push_integer(value)
        else:
            self.stack.append(value)

    def push_long(self, form: str) -> None:
        count = self.unpack(form)
        if count > _NUMBER_LENGTH:
            raise PickleError("holds a number of more than 64 bits")
        self.push_integer(int.from_bytes(self.take(count), "little", signed=True))

    def push_raw(self, form: str, encoding: str | None) -> None:
        self.stack.append(Raw(self.take(self.unpack(form)), encoding))

    def push_escaped_string(self) -> None:
        line = self.line()
        if len(line) < 2 or line[:1] not in (b"'", b'"') or line[-1:] != line[:1]:
            raise self.damaged()
        try:
            self.stack.append(Raw(memoryview(codecs.escape_decode(line[1:-1])[0]), "latin1"))
        except ValueError:
            raise self.damaged() from None

    def push_escaped_text(self) -> None:
        try:
            self.stack.append(str(self.line(), "raw-unicode-escape"))
        except UnicodeDecodeError:
            raise self.damaged() from None

    def push_name(self, module: str | bytes, name: str | bytes) -> None:
        # A name that is not ASCII is none that we know.
        module, name = (str(part, "ascii", "replace") if isinstance(part, bytes) else part for part in (module, name))
        kind = self.known.get((module, name))
        if kind is None:
            raise PickleError(f"asks for {shown(module)}.{shown(name)}, which no plain data needs; nothing of it was run")
        self.stack.append(Name(f"{module}.{name}", kind))

    def push_stack_name(self) -> None:
        name, module = (value.value if isinstance(value, Raw) else value for value in (self.pop(), self.pop()))
        if not isinstance(name, str) or not isinstance(module, str):
            raise self.damaged()
        self.push_name(module, name)

    def push_call(self) -> None:
        args, name = self.pop(), self.pop()
        if not isinstance(name, Name) or not isinstance(args, tuple):
            raise self.damaged()
        self.stack.append(Call(name, args))

    def push_call_without_keywords(self) -> None:
        if self.pop() != {}:
            raise PickleError("makes an object with keyword arguments, which no plain data needs")
        self.push_call()

    def build(self) -> None:
        state, call = self.pop(), self.peek()
        if not isinstance(call, Call) or call.state is not None:
            raise self.damaged()
        call.state = state

    def put(self, index: int) -> None:
        self.memo[index] = self.peek()

    def get(self, index: int) -> None:
        if index not in self.memo:
            raise self.damaged()
        self.stack.append(self.memo[index])

    def put_line(self) -> None:
        self.put(self.index_line())

    def get_line(self) -> None:
        self.get(self.index_line())

    def index_line(self) -> int:
        line = self.line(_NUMBER_LENGTH)
        if not line.isdigit():
            raise self.damaged()
        return int(line)

    def append(self, values: list) -> None:
        target = self.peek()
        if type(target) is not list:
            raise self.damaged()
        target.extend(values)

    def add(self, values: list) -> None:
        target = self.peek()
        if type(target) is not set:
            raise self.damaged()
        target.update(map(_key, values))

    def set_items(self, values: list) -> None:
        target = self.peek()
        if isinstance(target, Call):
            target = target.items
        if type(target) is not dict:
            raise self.damaged()
        target.update(self.pairs(values))

    def pairs(self, values: list) -> dict:
        if len(values) % 2:
            raise self.damaged()
        return {_key(key): value for key, value in zip(values[::2], values[1::2], strict=True)}

    def push_tuple(self, count: int) -> None:
        begin = len(self.stack) - count
        if begin < (self.marks[-1] if self.marks else 0):
            raise self.damaged()
        self.stack[begin:] = [tuple(self.stack[begin:])]

    def check_protocol(self) -> None:
        if self.unpack("<B") > 5:
            raise PickleError("has a pickle protocol above 5, or is none")

    def refuse_instance(self) -> None:
        self.push_name(self.line(), self.line())
        raise PickleError(f"holds an old-style instance of {shown(self.pop().path)}, which no plain data needs")


def _key(value: Any) -> Any:
    """Take only what has a hash that is quick, and cannot be chosen to collide (integers have at most 64 bits)."""
    if isinstance(value, Raw):
        return value.value
    if value is None or isinstance(value, (str, int, float, bytes)):
        return value
    raise PickleError("has a key that is neither text nor a number")


def _integer_of(line: bytes) -> int:
    return {b"00": False, b"01": True}[line] if line in (b"00", b"01") else int(line)


def _refuse(what: str) -> Callable[[_Machine], None]:
    def refuse(machine: _Machine) -> None:
        raise PickleError(f"refers to {what}, which no plain data needs")

    return refuse


_EXTENSION = _refuse("a class by a registered number")
_PERSISTENT = _refuse("something that is kept outside the file")
_BUFFER = _refuse("a buffer that is kept outside the file")

_OPERATIONS: dict[int, Callable[[_Machine], Any]] = {
    ord(code) if isinstance(code, str) else code: operation
    for code, operation in {
        # the stack and the memo
        "(": lambda m: m.marks.append(len(m.stack)),
        "0": lambda m: m.pop() if len(m.stack) > (m.marks[-1] if m.marks else 0) else m.pop_to_mark(),
        "1": lambda m: m.pop_to_mark(),
        "2": lambda m: m.push(m.peek()),
        "p": _Machine.put_line,
        "q": lambda m: m.put(m.unpack("<B")),
        "r": lambda m: m.put(m.unpack("<I")),
        0x94: lambda m: m.put(len(m.memo)),
        "g": _Machine.get_line,
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
        "S": _Machine.push_escaped_string,
        "T": lambda m: m.push_raw("<i", "latin1"),
        "U": lambda m: m.push_raw("<B", "latin1"),
        "V": _Machine.push_escaped_text,
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
        0x91: lambda m: m.push(frozenset(map(_key, m.pop_to_mark()))),
        # objects
        "c": lambda m: m.push_name(m.line(), m.line()),
        0x93: _Machine.push_stack_name,
        "R": _Machine.push_call,
        0x81: _Machine.push_call,
        0x92: _Machine.push_call_without_keywords,
        "b": _Machine.build,
        "i": _Machine.refuse_instance,
        "o": _refuse("an old-style class"),
        "P": _PERSISTENT,
        "Q": _PERSISTENT,
        0x82: _EXTENSION,
        0x83: _EXTENSION,
        0x84: _EXTENSION,
        0x97: _BUFFER,
        0x98: _BUFFER,
        # Frames only say how much to read at once.
        0x80: _Machine.check_protocol,
        0x95: lambda m: m.take(8),
    }.items()
}
