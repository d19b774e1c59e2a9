"""Forward skinning for neural fields: the weight grid, the correspondence search and its exact gradient.

Usable alone, in any neural field: see `ForwardDeformer`.
"""

from snarfcli.deformer.bone_prior import BonePrior
from snarfcli.deformer.canonical_body import CanonicalBody
from snarfcli.deformer.cells import cells_near
from snarfcli.deformer.correspondences import Correspondences
from snarfcli.deformer.deformer import ForwardDeformer
from snarfcli.deformer.diffusion import PresetWeights
from snarfcli.deformer.field_search import find_correspondences_on_field
from snarfcli.deformer.grid import CanonicalGrid
from snarfcli.deformer.grid_search import find_correspondences
from snarfcli.deformer.map_search import find_correspondences_on_map
from snarfcli.deformer.posed import PosedDeformer
from snarfcli.deformer.search_config import SearchConfig
from snarfcli.deformer.skinning import blend_transforms, blended_matrices, inverse_skin, skin
from snarfcli.deformer.skinning_config import BodySkinningConfig, SkinningConfig
from snarfcli.deformer.weights import NodeWeights, WeightField

__all__ = [
    "BodySkinningConfig",
    "BonePrior",
    "CanonicalBody",
    "CanonicalGrid",
    "Correspondences",
    "ForwardDeformer",
    "NodeWeights",
    "PosedDeformer",
    "PresetWeights",
    "SearchConfig",
    "SkinningConfig",
    "WeightField",
    "blend_transforms",
    "blended_matrices",
    "cells_near",
    "find_correspondences",
    "find_correspondences_on_field",
    "find_correspondences_on_map",
    "inverse_skin",
    "skin",
]
