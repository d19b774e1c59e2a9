from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import pytest

from snarfcli.descriptions import DescriptionError, check_plain, read_described


@dataclass
class Inner:
    name: str
    sizes: list[float] = field(default_factory=lambda: [1.0])
    """Unused."""


@dataclass
class Outer:
    inner: Inner
    count: int = 3
    share: float | None = 0.5
    is_open: bool = False
    parts: tuple[Inner, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    more: Any = None
    given: str = "???"


GOOD = {
    "inner": {"name": "${oc.env:HOME}", "sizes": [1, 2.5]}, "count": 4, "share": None, "is_open": True,
    "parts": [{"name": "a"}, {"name": "b"}], "seconds": {"train": 3}, "more": {"any": [1, "x", None]}, "given": "",
}  # fmt: skip


def changed(**values):
    return {**GOOD, **values}


def test_an_object_of_its_description():
    outer = read_described(Outer, GOOD, "config")
    assert outer.inner == Inner("${oc.env:HOME}", [1.0, 2.5])  # text, never resolved
    assert (outer.count, outer.share, outer.is_open, outer.parts[1].name) == (4, None, True, "b")
    assert outer.seconds == {"train": 3.0}
    assert isinstance(outer.inner.sizes[0], float)
    assert outer.more == GOOD["more"]
    assert read_described(Outer, {"inner": {"name": "a"}, "given": "x"}, "") == Outer(Inner("a"), given="x")


def circular():
    content: dict = {}
    content["a"] = [content]
    return content


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "config: wanted names with values, got a list"),
        (changed(inner=3), "config.inner: wanted names with values, got 3"),
        (changed(inner={}), "config.inner.name: wanted a value, got none"),
        ({"inner": {"name": "a"}}, "config.given: wanted a value, got none"),
        (changed(cuont=3), "config: cuont is no setting of this version; did you mean 'count'?"),
        (changed(count=3.0), "config.count: wanted a whole number, got 3.0"),
        (changed(count=True), "config.count: wanted a whole number, got True"),
        (changed(count="3"), "config.count: wanted a whole number, got '3'"),
        (changed(count=None), "config.count: wanted a whole number, got None"),
        (changed(is_open=1), "config.is_open: wanted true or false, got 1"),
        (changed(share="x" * 100), "config.share: wanted a number, got a str"),
        (changed(share=float("nan")), "config.share: wanted a finite number, got nan"),
        (changed(share=10**400), "config.share: wanted a number of at most 19 digits, got a longer one"),
        (changed(more=[float("inf")]), "config.more: wanted a finite number, got inf"),
        (changed(more={1: 2}), "config.more: wanted texts as names, got 1"),
        (changed(more={10**5000: 2}), "config.more: wanted texts as names, got a int"),
        (changed(more=b"x"), "config.more: wanted plain data, got a bytes"),
        (changed(more=circular()), "config: wanted at most 20 levels, got more"),
        (changed(more=[0] * 1_000_001), "config: wanted at most 1000000 values, got more"),
        (changed(more="x" * 200_000), "config.more: wanted a text of at most 100000 characters, got 200000"),
        (changed(more="\ud800"), "config.more: wanted a text that can be written, got '\\ud800'"),
        (changed(more={"\x1b[2J": b""}), "config.more.[2J: wanted plain data, got a bytes"),
        (changed(inner={"name": "a", "sizes": "12"}), "config.inner.sizes: wanted a list, got '12'"),
        (changed(inner={"name": "a", "sizes": [1, "2"]}), "config.inner.sizes[1]: wanted a number, got '2'"),
        (changed(parts={"name": "a"}), "config.parts: wanted a list, got a dict"),
        (changed(seconds={"a": "b"}), "config.seconds.a: wanted a number, got 'b'"),
    ],
)
def test_wrong_descriptions_are_named_in_one_line(content, message):
    with pytest.raises(DescriptionError, match=re.escape(message)) as caught:
        read_described(Outer, content, "config")
    assert str(caught.value).isprintable()


def test_names_without_a_field_may_be_left_out():
    assert read_described(Inner, {"name": "a", "age": 3}, "x", ignore_unknown=True) == Inner("a")


def test_infinity_may_be_allowed():
    check_plain({"a": [float("inf")]}, "x", finite=False)
