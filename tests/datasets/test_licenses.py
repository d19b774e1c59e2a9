from __future__ import annotations

from pathlib import Path

import pytest

from snarfcli.datasets.licenses import license_of

CONF = Path(__file__).parents[2] / "conf" / "data"


@pytest.mark.parametrize(("data", "identifier"), [("builtin", "cc0-1.0"), ("clothed", "cc0-1.0"), ("stick2d", "cc0-1.0")])
def test_own_data_is_in_the_public_domain(data, identifier):
    assert license_of({"data": data}).identifier == identifier


@pytest.mark.parametrize("data", ["dfaust", "poseprior", "cape"])
def test_licensed_data_may_not_be_passed_on(data):
    assert license_of({"data": data}).text.startswith("Not for redistribution")
    assert license_of({"data": data}).identifier == "other"


@pytest.mark.parametrize("facts", [{}, {"data": None}, {"data": "meshes"}, {"data": "amass"}, {"data": ["builtin"]}])
def test_of_other_data_nothing_is_claimed(facts):
    assert license_of(facts).identifier == "other"
    assert license_of(facts).text.startswith("None is stated")


def test_every_data_set_has_an_answer():
    names = {path.stem for path in CONF.glob("*.yaml")}
    assert names == {"builtin", "clothed", "stick2d", "dfaust", "poseprior", "cape", "meshes", "amass"}
