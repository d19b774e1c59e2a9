"""What several kernels take as arguments."""

from __future__ import annotations

import torch

from snarfcli.native.cuda_arrays import aligned, feature_levels


def test_levels_point_to_their_rows():
    rows = torch.zeros(2 * 3 * 4 + 8, dtype=torch.int32)
    boxes = [0.0, 1.0, 2.0, 0.25, 0.5, 0.1, -1.0, -2.0, -3.0, 1.0, 2.0, 4.0]
    levels = feature_levels(3, torch.zeros(7, 2), rows, [4, 3, 2, 2, 2, 2], boxes)
    assert len(levels) == 3
    assert [level.rows for level in levels[:2]] == [rows.data_ptr(), rows.data_ptr() + 4 * 24]
    assert [list(level.nodes) for level in levels] == [[4, 3, 2], [2, 2, 2], [0, 0, 0]]
    assert list(levels[0].lower) == [0, 1, 2]
    assert torch.equal(torch.tensor([*levels[0].per_metre]), 1 / torch.tensor(boxes[3:6]))
    assert [level.row_count for level in levels] == [7, 7, 0]


def test_only_arrays_that_do_not_fit_are_copied():
    whole = torch.arange(64.0)
    for given in (whole[1:33].view(8, 4), whole[:64:2].view(8, 4)):
        found = aligned(given)
        assert found.is_contiguous()
        assert found.data_ptr() % 16 == 0
        assert torch.equal(found, given)
    assert aligned(whole).data_ptr() == whole.data_ptr()
