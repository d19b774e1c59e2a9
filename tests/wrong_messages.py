"""Messages that the page of the viewer never sends, for the tests and `tools/trust_viewer.py`."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from typing import Any

__all__ = ["CAMERA", "CLICK", "DRAG", "WRONG_VALUES", "wrong_bytes", "wrong_messages"]

CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, 0, 3], "fov": 0.8, "near": 0.1, "far": 100,
    "image_height": 480, "image_width": 640, "look_at": [0, 0, 0], "up_direction": [0, 1, 0],
}  # fmt: skip
CLICK: dict[str, Any] = {
    "type": "SceneNodeClickMessage", "name": "/skeleton/joints", "instance_index": 1, "ray_origin": [0, 0, 3],
    "ray_direction": [0, 0, -1], "screen_pos": [0.5, 0.5], "modifier": None, "owner": "",
}  # fmt: skip
DRAG: dict[str, Any] = {
    "type": "TransformControlsUpdateMessage", "name": "/handle", "wxyz": [1, 0, 0, 0], "position": [0, 0, 0], "owner": "",
}  # fmt: skip

# Values of the list below that some fields may have.
_RIGHT: dict[str, tuple[Any, ...]] = {
    **dict.fromkeys(("near", "far", "image_height", "image_width"), (3000,)),
    **dict.fromkeys(("position", "look_at", "up_direction", "ray_origin", "ray_direction"), ([256, 0, 0], [0, 0, -1])),
    "modifier": (None,),
    "owner": ("",),
}
WRONG_VALUES: tuple[Any, ...] = (
    None, -(10**9), 10**18, 3000, "3000", float("nan"), float("inf"), -1e308, "", "x" * 5000, "{alert(1)}", [], [[[1]]],
    [1e400] * 3, [256, 0, 0], [0, 0, -1], [1, 2, 3, 4], {}, {"value": 1}, b"bytes", "\x1b[2J",
)  # fmt: skip
"""Values that no input of the page offers."""

_UNUSED = (
    {"type": "ShareUrlRequest"},
    {"type": "ShareUrlDisconnect"},
    {"type": "GuiButtonHoldMessage", "uuid": "x", "frequency": 10.0},
    {"type": "FileTransferStartUpload", "source_component_uuid": "x", "transfer_uuid": "y", "filename": "a",
     "mime_type": "b", "part_count": 10**9, "size_bytes": 10**12},
    {"type": "FileTransferPart", "source_component_uuid": "x", "transfer_uuid": "y", "part_index": 0, "content": b"z" * 5000},
    {"type": "CommandTriggerMessage", "uuid": "x"},
    {"type": "RunJavascriptMessage", "source": "alert(1)"},
    {"type": "ScenePointerMessage", "event_type": "click"},
    {"type": "GuiRemoveMessage", "uuid": "x"},
    {"type": "ResetGuiMessage"},
    {"type": "Message"}, {"type": None}, {"type": ["a"]}, {"type": 1}, {},
)  # fmt: skip


def wrong_messages(inputs: Sequence[str], source: random.Random) -> Iterator[dict[str, Any]]:
    """Yield messages of every kind that are wrong in one place each.

    Args:
        inputs: viser's identifiers of inputs.
        source: random numbers, for their order.
    """
    messages: list[dict[str, Any]] = list(_UNUSED)
    for good in (CAMERA, CLICK, DRAG):
        for name in good.keys() - {"type"}:
            right = _RIGHT.get(name, ())
            messages += [{**good, name: value} for value in WRONG_VALUES if value not in right]
            messages.append({key: value for key, value in good.items() if key != name})
        messages.append({**good, "more": 1})
    for uuid in inputs:
        messages += [{"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}} for value in WRONG_VALUES]
        messages += [
            {"type": "GuiUpdateMessage", "uuid": uuid, "updates": updates}
            for updates in ({}, {"removed": True}, {"update_cb": []}, {"value": True, "label": "x"}, None, [])
        ]
    messages += [{"type": "GuiUpdateMessage", "uuid": value, "updates": {"value": 1}} for value in ("no such", 1, None, [], {})]
    source.shuffle(messages)
    yield from messages


def wrong_bytes(source: random.Random) -> list[bytes]:
    """Return messages that are not of viser's format."""
    deep = b"\x81\xa4type" + b"\x91" * 5000
    huge = [b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\x81\xa4type\xdb\xff\xff\xff\xff"]
    return [
        b"",
        b"\xc1",
        b"null",
        b"{}",
        b"\xa1x",
        b"\x93\x01\x02\x03",
        deep,
        *huge,
        *(source.randbytes(50) for _ in range(20)),
    ]
