"""Forward skinning for neural fields: the weight grid, the correspondence search and its exact gradient.

Usable alone, in any neural field: see `ForwardDeformer`.
"""

from snarfcli.deformer.correspondences import Correspondences, find_correspondences
from snarfcli.deformer.deformer import ForwardDeformer, SkinningConfig, cells_near
from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.deformer.search import SearchConfig
from snarfcli.deformer.skinning import blend_transforms, skin
from snarfcli.deformer.weights import BonePrior

__all__ = [
    "BonePrior",
    "CanonicalGrid",
    "Correspondences",
    "ForwardDeformer",
    "SearchConfig",
    "SkinningConfig",
    "blend_transforms",
    "cells_near",
    "find_correspondences",
    "skin",
]
