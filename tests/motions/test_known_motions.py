"""Files that were read right are read as before."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from known_motions import KNOWN_MOTIONS

from snarfcli.bodies import builtin_body
from snarfcli.motions import read_motion

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "known_motions.json").read_text())


@pytest.mark.parametrize("name", KNOWN_MOTIONS)
@pytest.mark.parametrize("body", ["adult", "builtin"])
def test_files_are_read_as_before(tmp_path, name, body):
    motion = read_motion(KNOWN_MOTIONS[name](tmp_path), None if body == "adult" else builtin_body().skeleton())
    kept = GOLDEN[name][body]
    np.testing.assert_allclose(motion.poses, kept["poses"], atol=2e-5)
    np.testing.assert_allclose(motion.translation, kept["translation"], atol=2e-5)
    assert motion.frame_rate == pytest.approx(kept["frame_rate"])
