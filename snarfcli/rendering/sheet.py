"""Contact sheets: pictures in rows and columns with labels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from snarfcli.files import atomic_path

__all__ = ["contact_sheet", "text_strip", "write_png"]

_INK = (52, 56, 62)
_PAPER = (247, 248, 249)
_EMPTY = (232, 234, 236)
_GAP = 8


def contact_sheet(
    rows: Sequence[Sequence[np.ndarray | None]],
    *,
    row_labels: Sequence[str] | None = None,
    column_labels: Sequence[str] | None = None,
    captions: Sequence[Sequence[str | None]] | None = None,
    title: str | None = None,
) -> np.ndarray:
    """Arrange pictures in a grid.

    Args:
        rows: pictures [H, W, 3] uint8, all of one size; None leaves a cell empty.
        row_labels: one line above each row.
        column_labels: one line above each column.
        captions: one line below each picture.
        title: one line at the top.

    Returns:
        [H', W', 3] uint8. Labels that are too wide are shortened.

    Raises:
        ValueError: there are no pictures, sizes differ, or the number of labels does not match that of the pictures.
    """
    from PIL import Image, ImageDraw

    pictures = [picture for row in rows for picture in row if picture is not None]
    if not pictures:
        raise ValueError("rows: wanted at least one picture, got none")
    height, width = pictures[0].shape[:2]
    for picture in pictures:
        if picture.shape != (height, width, 3) or picture.dtype != np.uint8:
            raise ValueError(f"rows: wanted all pictures [{height}, {width}, 3] uint8, got {list(picture.shape)}")
    columns = max(len(row) for row in rows)
    for name, labels, wanted in (("row_labels", row_labels, len(rows)), ("column_labels", column_labels, columns)):
        if labels is not None and len(labels) != wanted:
            raise ValueError(f"{name}: wanted {wanted} labels, got {len(labels)}")
    if captions is not None and [len(line) for line in captions] != [len(row) for row in rows]:
        got = [len(line) for line in captions]
        raise ValueError(f"captions: wanted one for each picture, {[len(row) for row in rows]} by rows, got {got}")

    small, large = _font(min(max(12, width // 24), 20)), _font(min(max(15, width // 17), 28))
    line_s, line_l = _line(small), _line(large)
    top = _GAP + (line_l if title else 0) + (line_s if column_labels else 0)
    row_height = (line_s if row_labels else 0) + height + (line_s if captions else 0) + _GAP
    sheet = Image.new("RGB", (_GAP + columns * (width + _GAP), top + len(rows) * row_height), _PAPER)
    draw = ImageDraw.Draw(sheet)

    def write(text: str | None, x: int, y: int, font, room: int) -> None:
        if text:
            draw.text((x, y), _shortened(text, font, room), fill=_INK, font=font)

    write(title, _GAP, _GAP, large, sheet.width - 2 * _GAP)
    for column, label in enumerate(column_labels or []):
        write(label, _GAP + column * (width + _GAP), top - line_s, small, width)
    for index, row in enumerate(rows):
        y = top + index * row_height
        if row_labels:
            write(row_labels[index], _GAP, y, small, sheet.width - 2 * _GAP)
            y += line_s
        for column, picture in enumerate(row):
            x = _GAP + column * (width + _GAP)
            if picture is None:
                draw.rectangle((x, y, x + width - 1, y + height - 1), fill=_EMPTY)
            else:
                sheet.paste(Image.fromarray(picture), (x, y))
            if captions:
                write(captions[index][column], x, y + height, small, width)
    return np.asarray(sheet)


def text_strip(labels: Sequence[str], part: int) -> np.ndarray:
    """Return a strip [H, W, 3] uint8 with the labels centred on parts of `part` pixels, one pixel between them.

    Labels that are too wide are shortened. The height depends on `part` only.
    """
    from PIL import Image, ImageDraw

    font = _font(min(max(10, part // 24), 40))
    line = _line(font)
    strip = Image.new("RGB", (len(labels) * (part + 1) - 1, line), _PAPER)
    draw = ImageDraw.Draw(strip)
    for index, label in enumerate(labels):
        middle = index * (part + 1) + part / 2
        draw.text((middle, line / 2), _shortened(label, font, part - 2), fill=_INK, font=font, anchor="mm")
    return np.asarray(strip)


def write_png(path: str | Path, picture: np.ndarray) -> None:
    """Write a picture [H, W, 3] uint8 as PNG, whole or not at all."""
    from PIL import Image

    with atomic_path(path) as temporary:
        Image.fromarray(picture).save(temporary, format="PNG", optimize=True)


def _font(size: int):
    from PIL import ImageFont

    return ImageFont.load_default(size=size)


def _line(font) -> int:
    """Return the height of a line of text with its margin, pixels."""
    ascent, descent = font.getmetrics()
    return ascent + descent + 6


def _shortened(text: str, font, room: int) -> str:
    """Return the text, shortened with dots at its end if it is wider than `room` pixels."""
    if font.getlength(text) <= room:
        return text
    while text and font.getlength(text + "...") > room:
        text = text[:-1]
    return text + "..."
