"""Names of searches: those of the presets, and different ones for all other settings."""

from __future__ import annotations

import re
from typing import cast

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from snarfcli.commands.evaluate import EvalConfig
from snarfcli.commands.search_names import search_name
from snarfcli.deformer import SearchConfig
from snarfcli.hydra_config.schema import config_folder, group_options, register_schemas


@pytest.fixture
def composed():
    """The search of `snarf eval` with given overrides."""
    register_schemas("eval", EvalConfig)
    with initialize_config_dir(str(config_folder().absolute()), version_base="1.3"):
        yield lambda *overrides: cast(EvalConfig, OmegaConf.to_object(compose("eval", list(overrides)))).search


def test_a_preset_has_its_own_name(composed):
    for name in group_options("search"):
        assert search_name(composed(f"search={name}")) == name
    assert search_name(SearchConfig()) == "complete"


def test_other_settings_have_the_name_of_the_nearest_preset_and_a_hash(composed):
    settings = [
        ("snarf", "search.max_steps=10"), ("snarf", "search.max_steps=50"), ("broyden", "search.max_steps=20"),
        ("broyden", "search.jacobian=broyden"), ("complete", "search.backend=reference"),
    ]  # fmt: skip
    names = [search_name(composed(f"search={preset}", setting)) for preset, setting in settings]
    assert [name.split("-")[0] for name in names] == [preset for preset, _ in settings]
    assert all(re.fullmatch(r"[a-z]+-[0-9a-f]{6}", name) for name in names)
    assert len(set(names)) == len(names)
    assert search_name(composed("search=snarf", "search.max_steps=10")) == names[0], "the same in every call"
