from __future__ import annotations

import logging
import re
import sys

import numpy as np
import pytest
import trimesh
from broken_packages import NO_LIBRARY, install_broken

from snarfcli.commands.doctor_tools import tools
from snarfcli.datasets.garment import _union
from snarfcli.errors import UserError
from snarfcli.export.decimate import decimate
from snarfcli.extras.meshlab import INSTALL_MESHLAB, why_no_meshlab
from snarfcli.meshing.mesh import Mesh
from snarfcli.sampling import choose_poisson, surface_samples

WITHOUT_PLUGINS = """
class MeshSet:
    def generate_boolean_union(self): ...
    def generate_sampling_poisson_disk(self): ...
"""  # as without libOpenGL.so.0
BALL = trimesh.creation.icosphere(2, 0.5)


@pytest.fixture(
    params=[
        ("", f"pymeshlab cannot be imported: {NO_LIBRARY}"),
        ("raise OSError('a DLL failed\\nto load')", "pymeshlab cannot be imported: a DLL failed to load"),
        ("import no_such_module", "pymeshlab cannot be imported: No module named 'no_such_module'"),
        (WITHOUT_PLUGINS, "pymeshlab could not load its plugin with meshing_decimation_quadric_edge_collapse"),
        (None, "pymeshlab is not installed"),
    ],
    ids=["library", "DLL", "package", "plugin", "nothing"],
)
def reason(request, monkeypatch, tmp_path) -> str:
    """Make MeshLab unusable; why."""
    code, reason = request.param
    if code is None:
        monkeypatch.setitem(sys.modules, "pymeshlab", None)
    else:
        install_broken(monkeypatch, tmp_path / "packages", "pymeshlab", code)
    return reason


def test_meshlab_works_where_it_is_installed():
    pytest.importorskip("pymeshlab")
    assert why_no_meshlab() is None


def test_the_reason_is_one_line(reason):
    assert why_no_meshlab() == reason


def test_samples_are_spread_without_it(reason, caplog):
    with caplog.at_level(logging.INFO, "snarfcli"):
        poisson = choose_poisson("auto")
    assert f"surface points are spread by snarf's own code, since {reason} (poisson=own)" in caplog.text
    assert len(surface_samples(BALL.vertices, BALL.faces, 50, np.random.default_rng(0), poisson)) == 50
    message = f"poisson: wanted MeshLab, but {reason}; give poisson=own, or install it with: {INSTALL_MESHLAB}"
    with pytest.raises(UserError, match=f"^{re.escape(message)}$"):
        choose_poisson("pymeshlab")


def test_libigl_decimates(reason, caplog):
    with caplog.at_level(logging.INFO, "snarfcli"):
        assert len(decimate(Mesh(BALL.vertices, BALL.faces), 200).faces) == 200
    assert f"decimating with libigl, since {reason}" in caplog.text


def test_clothes_need_it(reason):
    message = f"data=clothed joins body and garment with MeshLab, but {reason}; install it with: {INSTALL_MESHLAB}"
    with pytest.raises(UserError, match=f"^{re.escape(message)}$"):
        _union((BALL.vertices, BALL.faces), (BALL.vertices, BALL.faces))


def test_the_doctor_sees_it(reason):
    found = {finding.name: finding for finding in tools()}
    assert found["pymeshlab"].is_fallback
    told = found["pymeshlab"].text
    assert reason in told
    assert "snarf spreads the surface points (poisson=own) and libigl decimates" in told
    assert "apt install libgl1 libopengl0" in told
