from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from snarfcli.rendering.sheet import contact_sheet, write_png


def tile(value: int) -> np.ndarray:
    return np.full((60, 80, 3), value, np.uint8)


def test_pictures_stand_in_their_places(tmp_path):
    sheet = contact_sheet([[tile(10), tile(20)], [tile(30), None]])
    assert sheet.shape == (8 + 2 * 68, 8 + 2 * 88, 3)
    assert (sheet[8:68, 8:88] == 10).all()
    assert (sheet[8:68, 96:176] == 20).all()
    assert (sheet[76:136, 8:88] == 30).all()
    assert len(np.unique(sheet[76:136, 96:176])) <= 3
    write_png(tmp_path / "folder" / "sheet.png", sheet)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "folder" / "sheet.png")), sheet)


def test_labels_make_room_for_themselves():
    plain = contact_sheet([[tile(10)] * 2] * 2)
    labelled = contact_sheet(
        [[tile(10)] * 2] * 2,
        title="worst and best frames of a test with a title that is far too long for two small pictures",
        row_labels=["worst", "best"],
        column_labels=["prediction", "ground truth"],
        captions=[["a", None], ["c", "d"]],
    )
    assert labelled.shape[1] == plain.shape[1]
    assert labelled.shape[0] > plain.shape[0] + 60
    assert (labelled == 10).all(axis=2).sum() == 4 * 60 * 80
    assert labelled[:20].min() < 100  # ink of the title


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rows": [[None]]}, "rows: wanted at least one picture"),
        ({"rows": [[tile(1), tile(1)[:50]]]}, "rows: wanted all pictures"),
        ({"rows": [[tile(1)]], "row_labels": ["a", "b"]}, "row_labels: wanted 1 labels, got 2"),
        ({"rows": [[tile(1)]], "captions": [[]]}, "captions: wanted one for each"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        contact_sheet(**arguments)
