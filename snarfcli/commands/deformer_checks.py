"""Checks of the settings of weight fields and searches, before any work starts."""

from __future__ import annotations

from snarfcli.checks import check_choice, check_number, check_positive
from snarfcli.deformer import BodySkinningConfig, SearchConfig
from snarfcli.deformer.hierarchy import SOFTMAXES
from snarfcli.deformer.search_config import BACKENDS, JACOBIANS, SEARCHES
from snarfcli.deformer.skinning_config import FIELDS
from snarfcli.errors import UserError

__all__ = ["check_search", "check_skinning"]


def check_search(search: SearchConfig) -> None:
    """Check the settings of the correspondence search; start bones are checked later, where the number of bones is known.

    Raises:
        UserError: a setting cannot be used.
    """
    check_choice("search.name", search.name, SEARCHES)
    check_choice("search.jacobian", search.jacobian, JACOBIANS)
    check_choice("search.backend", search.backend, BACKENDS)
    if search.name == "complete" and search.init_bones is not None:
        raise UserError("search.init_bones is for search=broyden; the complete search has no start bones")
    if search.name == "complete" and search.jacobian != "exact":
        raise UserError("search.jacobian=broyden is for search=broyden; the complete search uses the exact Jacobian")
    check_number("search.max_steps", search.max_steps, 1)
    check_positive("search.tolerance", search.tolerance)
    check_positive("search.divergence", search.divergence)


def check_skinning(skinning: BodySkinningConfig, search: SearchConfig) -> None:
    """Check the settings of the weight field, alone and together with the search.

    Raises:
        UserError: a setting cannot be used.
    """
    check_choice("skinning.name", skinning.name, FIELDS)
    check_choice("skinning.softmax", skinning.softmax, SOFTMAXES)
    for name, least in (("resolution", 2), ("margin_m", 0)):
        values = getattr(skinning, name)
        if len(values) != 3:
            raise UserError(f"skinning.{name}: wanted three numbers, along x, y and z, got {values}")
        for value in values:
            check_number(f"skinning.{name}", value, least)
    for name in ("width", "depth"):
        check_number(f"skinning.{name}", getattr(skinning, name), 1)
    check_number("skinning.smoothness", skinning.smoothness, 0)
    for name in ("sharpness", "prior_falloff_m"):
        check_positive(f"skinning.{name}", getattr(skinning, name))
    if skinning.smoothness and skinning.name != "voxel":
        raise UserError("skinning.smoothness is for skinning=voxel; the other fields are smooth without it")
    if skinning.symmetric and skinning.name != "voxel":
        raise UserError("skinning.symmetric is for skinning=voxel; leave it out")
    if skinning.weights_file is not None and skinning.name != "preset":
        raise UserError("skinning.weights_file is for skinning=preset; the other fields are learned")
    if skinning.name == "preset" and skinning.weights_file is None:
        raise UserError("skinning=preset needs skinning.weights_file=FILE, an .npz file with vertices and weights")
    if skinning.name == "mlp" and search.name != "broyden":
        raise UserError(
            f"search: wanted snarf or broyden with skinning=mlp, got {search.name}; give one of them, or leave search out"
        )
