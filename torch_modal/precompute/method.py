"""Which key-frames have modes of the surface itself rather than of the solid inside."""

from typing import Literal

from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.inspect import OPEN, open_part, signed_volume
from torch_modal.precompute.surface import CanonicalSurface

Method = Literal["auto", "solid", "shell"]
METHODS: tuple[Method, ...] = ("auto", "solid", "shell")

THIN = 0.01
"""Mean thickness, twice the volume over the area, in roots of the area, below which the shell is taken."""


def why_shell(surfaces: list[CanonicalSurface]) -> str:
    """Why a set of key-frames has modes of the surface itself; empty if of the solid."""
    for index, surface in enumerate(surfaces):
        mesh = Connectivity(surface.faces, len(surface.points))
        holes = open_part(surface.points, mesh)
        thickness = 2 * abs(signed_volume(surface.points, surface.faces)) / surface.area**1.5
        what = f"key-frame {index} is" if len(surfaces) > 1 else "the shape is"
        if holes > OPEN:
            return f"{what} open: a round hole with its boundary would have {holes:.2g} times its area"
        if thickness < THIN:
            return f"{what} thin: its mean thickness is {thickness:.2g} times the root of its area"
    return ""
