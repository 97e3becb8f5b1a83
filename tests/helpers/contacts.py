"""Contacts and accelerations of shapes, for the tests of in-betweens that do not pass through themselves."""

from conftest import Shapes
from torch import Tensor

import torch_modal as tm


def far(x: Tensor, shapes: Shapes) -> Tensor:
    """Pairs of triangles of parts that went through each other."""
    return tm.self_contacts(x, shapes.faces, ignore=shapes.keyframes).n_far


def peak_acceleration(frames: Tensor) -> float:
    """Largest second difference of a vertex in time."""
    return float((frames[2:] - 2 * frames[1:-1] + frames[:-2]).norm(dim=-1).max())
