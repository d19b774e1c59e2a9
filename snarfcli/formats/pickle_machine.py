"""The stack machine that carries out the opcodes of a pickle without calling anything."""

from __future__ import annotations

import codecs
import math
import struct
from collections.abc import Callable, Mapping
from typing import Any

from snarfcli.formats.pickle_numbers import checked_shape, dtype_of
from snarfcli.formats.pickle_tree import Call, Name, PickleError, Raw, shown

__all__ = ["PickleMachine", "plain_key"]

_NUMBER_LENGTH = 100  # bytes of a number
# What is accepted besides names: objects outside the file, and any other name.
_STORED, _UNKNOWN = ("", "stored"), ("", "unknown")


class PickleMachine:
    """The file, the stack, the marks and the memo of a pickle, and one method for each kind of step.

    Every method raises `PickleError` for a damaged pickle or one that asks for more than plain data.
    """

    def __init__(self, data: bytes, known: Mapping[tuple[str, str], str], start: int = 0) -> None:
        self.data, self.known = data, known
        self.view = memoryview(data)
        self.at = start
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

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

    # Operations shared by several opcodes.

    def push_integer(self, value: int) -> None:
        if not -(2**63) <= value < 2**64:
            raise PickleError("has a number of more than 64 bits")
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
            raise PickleError("has a number of more than 64 bits")
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
        # A name that is not ASCII is never a known one.
        module, name = (str(part, "ascii", "replace") if isinstance(part, bytes) else part for part in (module, name))
        kind = self.known.get((module, name)) if module else None  # without a module: the special kinds, not for files to name
        kind = kind or self.known.get(_UNKNOWN)
        if kind is None:
            raise PickleError(f"asks for {shown(module)}.{shown(name)}, which plain data does not need; nothing was executed")
        self.stack.append(Name(f"{module}.{name}", kind))

    def push_stack_name(self) -> None:
        name, module = (value.value if isinstance(value, Raw) else value for value in (self.pop(), self.pop()))
        if not isinstance(name, str) or not isinstance(module, str):
            raise self.damaged()
        self.push_name(module, name)

    def push_call(self) -> None:
        args, name = self.pop(), self.pop()
        if isinstance(name, Call) and name.name.kind in ("unknown", "stored"):  # such as the class of a model of PyTorch
            name = Name(name.name.path, "unknown")
        if not isinstance(name, Name) or not isinstance(args, tuple):
            raise self.damaged()
        self.stack.append(Call(name, args))

    def push_call_without_keywords(self) -> None:
        if self.pop() != {}:
            raise PickleError("creates an object with keyword arguments, which plain data does not need")
        self.push_call()

    def build(self) -> None:
        state, call = self.pop(), self.peek()
        if not isinstance(call, Call) or call.state is not None:
            raise self.damaged()
        call.state = state
        if call.name.kind == "array in file":
            call.args = (self.take_array(state),)

    def take_array(self, state: Any) -> Raw:
        """Take the bytes of an array that joblib writes into the pickle, behind the description of the array."""
        if not isinstance(state, dict):
            raise self.damaged()
        size = math.prod(checked_shape(state.get("shape"))) * dtype_of(state.get("dtype")).itemsize
        if state.get("numpy_array_alignment_bytes") is not None:
            self.take(self.unpack("<B"))
        return Raw(self.take(size), None)

    def push_stored(self, key: Any) -> None:
        if _STORED not in self.known:
            raise PickleError("refers to an object outside the file, which plain data does not need")
        self.stack.append(Call(Name("stored", "stored"), (key,)))

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
        if isinstance(target, Call) and target.name.kind == "unknown":
            return
        if type(target) is not list:
            raise self.damaged()
        target.extend(values)

    def add(self, values: list) -> None:
        target = self.peek()
        if type(target) is not set:
            raise self.damaged()
        target.update(map(plain_key, values))

    def set_items(self, values: list) -> None:
        target = self.peek()
        if isinstance(target, Call) and target.name.kind == "unknown":
            return
        if isinstance(target, Call):
            target = target.items
        if type(target) is not dict:
            raise self.damaged()
        target.update(self.pairs(values))

    def pairs(self, values: list) -> dict:
        if len(values) % 2:
            raise self.damaged()
        return {plain_key(key): value for key, value in zip(values[::2], values[1::2], strict=True)}

    def push_tuple(self, count: int) -> None:
        begin = len(self.stack) - count
        if begin < (self.marks[-1] if self.marks else 0):
            raise self.damaged()
        self.stack[begin:] = [tuple(self.stack[begin:])]

    def check_protocol(self) -> None:
        if self.unpack("<B") > 5:
            raise PickleError("has a pickle protocol above 5, or is not a pickle")

    def reject_instance(self) -> None:
        self.push_name(self.line(), self.line())
        raise PickleError(f"has an old-style instance of {shown(self.pop().path)}, which plain data does not need")


def plain_key(value: Any) -> Any:
    """Return a dictionary key or member of a set if it is plain: its hash is fast and cannot be made to collide.

    Raises:
        PickleError: it is neither text nor a number (integers have at most 64 bits).
    """
    if isinstance(value, Raw):
        return value.value
    if value is None or isinstance(value, (str, int, float, bytes)):
        return value
    raise PickleError("has a key that is neither text nor a number")
