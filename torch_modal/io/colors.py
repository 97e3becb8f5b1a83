"""Colours of files as glTF and USD hold them."""

import numpy as np

from torch_modal.arrays import FloatArray


def linear(colors: FloatArray) -> FloatArray:
    """Linear RGBA of sRGB colours in [0, 1]. *Shape:* ``(n, 3)`` or ``(n, 4)`` to ``(n, 4)``."""
    clipped = np.clip(colors, 0.0, 1.0)
    rgb = clipped[:, :3]
    rgb = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    alpha = clipped[:, 3:] if colors.shape[1] > 3 else np.ones((len(colors), 1))
    return np.concatenate([rgb, alpha], axis=1)
