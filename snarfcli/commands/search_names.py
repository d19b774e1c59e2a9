"""Short names of searches, so that results of different ones have different folders."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from typing import Any, cast

from omegaconf import OmegaConf

from snarfcli.deformer import SearchConfig
from snarfcli.hydra_config.schema import config_folder, group_options

__all__ = ["search_name"]

_DIGITS = 6


def search_name(search: SearchConfig) -> str:
    """Return the name of the preset in conf/search/ that has these settings, such as `snarf`.

    Other settings have the name of the preset that shares most of them, and a hash of all of them: `broyden-3fa2b1`.
    """
    given = asdict(search)
    presets = {name: _preset(name) for name in group_options("search")}
    differences = {name: sum(given[key] != value for key, value in preset.items()) for name, preset in presets.items()}
    # A preset with another kind of search shares only by chance what its kind does not use.
    nearest = min(presets, key=lambda name: (presets[name]["name"] != search.name, differences[name]))
    if not differences[nearest]:
        return nearest
    return f"{nearest}-{hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()[:_DIGITS]}"


def _preset(name: str) -> dict[str, Any]:
    """Return all settings of a preset."""
    written = cast(dict[str, Any], OmegaConf.to_container(OmegaConf.load(config_folder() / "search" / f"{name}.yaml")))
    written.pop("defaults")
    return asdict(SearchConfig(**written))
