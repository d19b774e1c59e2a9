"""The folder that gpu_check.py needs on another machine."""

from __future__ import annotations

import numpy as np
import pack_gpu_check
import pytest
import torch
from gpu_checks.packed_samples import copy_samples, frames_with_meshes
from toy_training import toy_store

from snarfcli.errors import UserError
from snarfcli.samples.store import SampleStore
from snarfcli.training.rough_shape import rough_canonical_points


def test_packed_samples_train_the_same_avatar_and_leave_out_other_meshes(tmp_path):
    store = toy_store(tmp_path / "data", frames=12)
    copy_samples(tmp_path / "data", tmp_path / "packed", "toy")
    packed = SampleStore.open(tmp_path / "packed", "builtin", "toy")
    packed.verify()
    assert torch.equal(rough_canonical_points(packed), rough_canonical_points(store))
    used = frames_with_meshes(store)
    assert sum(len(frames) for frames in used.values()) == 8
    for mine, theirs in zip(packed.all_sequences, store.all_sequences, strict=True):
        for frame in range(theirs.num_frames):
            assert np.array_equal(mine.points(frame), theirs.points(frame))
            assert np.array_equal(mine.occupancies(frame), theirs.occupancies(frame))
            if theirs.split == "train" and frame in used[theirs.name]:
                assert np.array_equal(mine.vertices(frame), theirs.vertices(frame))
            else:
                assert len(mine.vertices(frame)) == 0


def test_the_folder_is_listed_with_the_commands_and_has_a_limit(tmp_path, capsys, monkeypatch):
    (tmp_path / "wheels").mkdir()
    (tmp_path / "wheels" / "a.whl").write_bytes(bytes(2_000_000))
    (tmp_path / "scenes.pt").write_bytes(bytes(500_000))
    pack_gpu_check.report(tmp_path, "library.so")
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["2.0", "MB", "wheels"] in lines
    assert ["2.5", "MB", str(tmp_path)] in lines
    commands = [" ".join(line) for line in lines[-4:]]
    assert commands[0].startswith("python3 -m pip install -q --no-index --no-deps --target /tmp/site $PWD/")
    assert commands[1:3] == ["export PYTHONPATH=/tmp/site", f"export SNARF_NATIVE_LIBRARY=$PWD/{tmp_path.name}/library.so"]
    assert commands[3] == f"python3 benchmarks/gpu_check.py --pack {tmp_path.name}"
    monkeypatch.setattr(pack_gpu_check, "LIMIT_MB", 2)
    with pytest.raises(UserError, match="more than 2; name fewer packages"):
        pack_gpu_check.report(tmp_path, None)


def test_an_unknown_package_is_a_user_error(tmp_path):
    with pytest.raises(UserError, match="package no-such-package is not installed here"):
        pack_gpu_check.pack_wheels(tmp_path / "wheels", "3.12", ["no-such-package"])
