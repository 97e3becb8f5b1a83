"""Which key-frames have modes of the surface itself rather than of the solid inside."""

from typing import Literal

import numpy as np

from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.inspect import signed_volume
from torch_modal.precompute.surface import CanonicalSurface

Method = Literal["auto", "solid", "shell"]
METHODS: tuple[Method, ...] = ("auto", "solid", "shell")

OPEN = 0.02
"""Area of flat discs in the holes, as a fraction of the surface, above which the shell is taken."""
THIN = 0.01
"""Mean thickness, twice the volume over the area, in roots of the area, below which the shell is taken."""


def why_shell(surfaces: list[CanonicalSurface]) -> str:
    """Why a set of key-frames has modes of the surface itself; empty if of the solid."""
    for index, surface in enumerate(surfaces):
        mesh = Connectivity(surface.faces, len(surface.points))
        ends = surface.points[mesh.boundary_edges]
        around = float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum())
        holes = around**2 / (4 * np.pi * surface.area)
        thickness = 2 * abs(signed_volume(surface.points, surface.faces)) / surface.area**1.5
        what = f"key-frame {index} is" if len(surfaces) > 1 else "the shape is"
        if holes > OPEN:
            return f"{what} open: holes as long as its boundary would have {100 * holes:.2g} % of its area"
        if thickness < THIN:
            return f"{what} thin: its mean thickness is {100 * thickness:.2g} % of the root of its area"
    return ""
