"""`snarf doctor --pose FILE`: what was read, and a figure of both skeletons."""

from __future__ import annotations

import numpy as np
import pytest
from other_rigs import CONVENTIONS, rig_motion
from PIL import Image
from toy_rigs import write_bvh

from snarfcli.cli.main import main
from snarfcli.motions import builtin_motion

MOTION = builtin_motion("jumping_jacks", 3, duration_s=0.5)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_rig_is_drawn_beside_the_body(here, caplog):
    caplog.set_level("INFO", logger="snarfcli")
    source = rig_motion(MOTION, CONVENTIONS["legs_along_x"])
    write_bvh(here / "walk.bvh", source.rig)
    assert main(["doctor", "--pose", "walk.bvh"]) == 0
    shown = caplog.text
    assert "walk: 30 frames" in shown
    assert "24 of the body's 24 have one of the file's" in shown
    assert "l_hip from LeftUpLeg" in shown
    assert "not that of a standing person (left leg, right leg)" in shown
    picture = np.asarray(Image.open(here / "outputs/doctor/walk.png"))
    panels, cells = 4, 2
    assert picture.shape[1] > 360 * panels
    assert picture.shape[0] > 360 * cells
    orange = (np.abs(picture.astype(int) - (235, 94, 40)).sum(2) < 30).nonzero()[0]
    assert orange.min() < picture.shape[0] / 2 < orange.max()  # bones in both rows


def test_poses_have_no_skeleton_of_their_own(here, caplog):
    caplog.set_level("INFO", logger="snarfcli")
    np.savez("dance.npz", poses=MOTION.poses.reshape(-1, 72), trans=MOTION.translation, fps=60.0)
    assert main(["doctor", "--pose=dance.npz", "data=builtin", "subject=50004", "figure=here.png"]) == 0
    assert "on subject 50004 of builtin" in caplog.text
    assert Image.open("here.png").size[1] < 360 * 2


def test_a_subject_is_one_of_the_built_in_ones(here, caplog):
    caplog.set_level("INFO", logger="snarfcli")
    np.savez("dance.npz", poses=MOTION.poses.reshape(-1, 72))
    assert main(["doctor", "--pose=dance.npz", "subject=50009"]) == 0
    assert "on subject 50009 of builtin" in caplog.text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--pose", "none.bvh"], "no BVH file at none.bvh"),
        (["--pose", "walk.bvh", "up=w"], "up: wanted auto, y, z, x, -y"),
        (["--pose", "walk.bvh", "rest=bind"], "rest: wanted auto, file, clip or the number of a frame"),
        (["--pose", "walk.bvh", "rest=999"], "rest=999: wanted a frame from 0 to 29"),
    ],
)
def test_what_a_user_can_get_wrong(here, capsys, arguments, message):
    write_bvh(here / "walk.bvh", rig_motion(MOTION, CONVENTIONS["mixamo_t"]).rig)
    assert main(["doctor", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (here / "outputs").exists()
