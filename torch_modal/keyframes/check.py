"""Checks of key-frames: all errors and warnings about the input.

``docs/input.md`` lists the conditions. Messages count key-frames, vertices and faces from 0.
"""

import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from torch_modal.arrays import ArrayLike, FloatArray, IntArray
from torch_modal.errors import MeshError, MeshWarning
from torch_modal.geometry import inspect
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.rigid import looks_mirrored
from torch_modal.keyframes.arrays import as_faces, as_positions

__all__ = ["Keyframes", "MeshError", "MeshWarning", "check_keyframes"]

# Rounding of a length, relative to the coordinates.
_RESOLUTION = {torch.float32: 1e-6, torch.float64: 1e-12}
# Range of diagonals that can be scaled to 100 without overflow.
_DIAGONAL_RANGE = {torch.float32: (1e-30, 1e30), torch.float64: (1e-250, 1e250)}
_LARGEST_SIZE_RATIO = 100.0
# Visible rounding of the coordinates, relative to the diagonal.
_COARSE_ROUNDING = 1e-4
# Volume at a diagonal of 1 from which on its sign means something.
_LEAST_VOLUME = 1e-6


class Keyframes(NamedTuple):
    """Shapes with one connectivity."""

    keyframes: torch.Tensor
    """Vertex positions. *Shape:* ``(K, V, 3)``."""
    faces: torch.Tensor
    """Vertex indices, int64. *Shape:* ``(F, 3)``."""


def check_keyframes(keyframes: ArrayLike, faces: ArrayLike, *, min_keyframes: int = 1, warn: bool = True) -> Keyframes:
    """Check key-frames and repair their faces.

    Args:
        keyframes: Vertex positions in any units, float32 or float64, as a tensor, an array or a sequence of
            ``(V, 3)``. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices, of any integer type. *Shape:* ``(F, 3)``.
        min_keyframes: Required number of key-frames.
        warn: Emit warnings; errors are raised in any case.

    Returns:
        The unchanged positions, with their dtype, device and graph; the repaired faces, int64, on the same device.
        Repairs drop or flip faces; vertices are never dropped, added or reordered.

    Raises:
        MeshError: The input cannot work; the message gives the reason and a remedy.

    Warns:
        MeshWarning: At most once per kind of flaw, with the number of places and the first one.
    """
    positions, mesh = check_surface(keyframes, faces, min_keyframes, warn)
    return Keyframes(positions, torch.tensor(mesh.faces, device=positions.device))


def check_surface(
    keyframes: ArrayLike, faces: ArrayLike, min_keyframes: int = 1, warn: bool = False
) -> tuple[torch.Tensor, Connectivity]:
    """`check_keyframes` that returns the connectivity instead of the faces."""
    positions, shapes, indices = check_arrays(keyframes, faces, min_keyframes)
    mesh, orientable, repairs = _repair(indices, shapes.shape[1])
    scaled, far = _check_sizes(shapes, mesh, positions.dtype)
    if orientable and not (mesh.counts % 2).any():
        _refuse_mirrored(scaled, mesh.faces)
    if warn:
        same = np.argwhere((shapes[1:] == shapes[:-1]).all(axis=(1, 2))) + 1
        equal = _count(same, "key-frames are equal to the one before", lambda k: f"key-frame {k}")
        for message in filter(None, [*repairs, far, equal, *_flaws(scaled, mesh, _RESOLUTION[positions.dtype])]):
            warnings.warn(message, MeshWarning, stacklevel=3)
    return positions, mesh


def check_arrays(
    keyframes: ArrayLike, faces: ArrayLike, min_keyframes: int = 1
) -> tuple[torch.Tensor, FloatArray, IntArray]:
    """Check shapes and values of the arrays; return positions, unchanged and in float64, and faces.

    Raises:
        MeshError: Wrong shapes, values that are not finite, or invalid indices.
    """
    positions, indices = as_positions(keyframes), as_faces(faces)
    shape = tuple(positions.shape)
    if len(shape) != 3 or shape[2] != 3:
        raise MeshError(
            f"keyframes have shape {shape}; (K, V, 3) is needed: key-frames, vertices, coordinates; of a single shape, "
            "pass keyframes[None]"
        )
    if shape[0] < max(min_keyframes, 1):
        raise MeshError(f"{shape[0]} key-frame(s) arrived, at least {max(min_keyframes, 1)} are needed")
    if indices.ndim != 2 or indices.shape[1] != 3 or not len(indices):
        raise MeshError(
            f"faces have shape {indices.shape}; (F, 3) is needed: triangles, at least one, the same for all "
            "key-frames; cut quads along one diagonal, the same in all"
        )
    shapes = positions.detach().cpu().double().resolve_neg().numpy()
    missing = ((indices < 0) | (indices >= shape[1])).any(axis=1)
    from_one = "; indices count from 0, not from 1" if indices.min() == 1 and indices.max() == shape[1] else ""
    for message in (
        _count(
            np.argwhere(~np.isfinite(shapes).all(axis=2)),
            "vertices have NaN or infinite positions",
            lambda k, v: f"vertex {v} of key-frame {k}: {shapes[k, v].tolist()}",
        ),
        _count(
            np.argwhere(missing),
            "faces use vertices that do not exist",
            lambda f: f"face {f}, vertices {indices[f].tolist()}, with {shape[1]} vertices{from_one}",
        ),
    ):
        if message:
            raise MeshError(message)
    return positions, shapes, indices


def _count(places: IntArray, what: str, name: Callable[..., str]) -> str:
    """Message on the number of places with a flaw and on the first; empty if there are none. *Shape:* ``(n, i)``."""
    return f"{len(places)} {what}; the first is {name(*places[0])}" if len(places) else ""


def _repair(faces: IntArray, n_vertices: int) -> tuple[Connectivity, bool, list[str]]:
    """Drop degenerate and repeated faces, orient the others; return the mesh, its orientability, and messages."""
    degenerate = inspect.degenerate_faces(faces)
    repeated = inspect.find_repeated_faces(faces) & ~degenerate
    kept = np.flatnonzero(~degenerate & ~repeated)
    if len(kept) == 0:
        raise MeshError("all faces use a vertex twice, so none is a triangle")
    mesh = Connectivity(faces[kept], n_vertices)
    wound, flipped, non_orientable = inspect.consistent_winding(mesh)
    flaws = (
        (np.flatnonzero(degenerate), "use a vertex twice and were dropped"),
        (np.flatnonzero(repeated), "have the same vertices as an earlier face and were dropped"),
        (kept[flipped], "wind against their neighbours and were turned over"),
        (
            kept[non_orientable],
            "belong to a surface that has no consistent winding (like a Moebius strip) and were left as they are, so "
            "some dihedral angles have the wrong sign and the volume means nothing",
        ),
    )
    messages = [
        _count(bad[:, None], f"faces {what}", lambda i: f"face {i}, {faces[i].tolist()}") for bad, what in flaws
    ]
    return Connectivity(wound, n_vertices) if len(flipped) else mesh, not len(non_orientable), messages


def _check_sizes(shapes: FloatArray, mesh: Connectivity, dtype: torch.dtype) -> tuple[FloatArray, str]:
    """Reject unusable sizes; return centred shapes with a diagonal of 1, and a message on shapes that are far away."""
    surface = shapes[:, mesh.used]
    with np.errstate(over="ignore", invalid="ignore"):
        diagonals = inspect.diagonals(surface)
    largest = np.abs(surface).max(axis=(1, 2))
    low, high = _DIAGONAL_RANGE[dtype]
    for k, diagonal in enumerate(diagonals):
        if not max(low, _RESOLUTION[dtype] * largest[k]) < diagonal < high:
            raise MeshError(
                f"key-frame {k} has a bounding-box diagonal of {diagonal:.3g} at coordinates up to {largest[k]:.3g}, "
                f"which {dtype} cannot compute with: choose another unit, move it to the origin, or check its export"
            )
    far = _count(
        np.argwhere(torch.finfo(dtype).eps * largest > _COARSE_ROUNDING * diagonals),
        f"key-frames lie so far from the origin that {dtype} rounds their shape visibly: use float64, or move them",
        lambda k: f"key-frame {k} with coordinates up to {largest[k]:.3g} and a diagonal of {diagonals[k]:.3g}",
    )
    small, large = int(diagonals.argmin()), int(diagonals.argmax())
    if diagonals[large] > _LARGEST_SIZE_RATIO * diagonals[small]:
        raise MeshError(
            f"key-frame {large} has a bounding-box diagonal of {diagonals[large]:.3g}, key-frame {small} one "
            f"of {diagonals[small]:.3g}: more than {_LARGEST_SIZE_RATIO:.0f} times as large; they are "
            "probably in different units, so scale one of them"
        )
    with np.errstate(over="ignore"):  # unreferenced vertices, which are not used below
        return (shapes - surface.mean(axis=1, keepdims=True)) / diagonals[:, None, None], far


def _refuse_mirrored(scaled: FloatArray, faces: IntArray) -> None:
    """Reject closed meshes that are mirror images of each other. *Shape:* ``(K, V, 3), (F, 3)``."""
    volumes = np.array([inspect.volume_of(shape, faces) for shape in scaled])
    positive, turned = int(volumes.argmax()), np.flatnonzero(volumes < -_LEAST_VOLUME)
    if volumes[positive] > _LEAST_VOLUME and len(turned):
        first, others = (torch.from_numpy(scaled[rows]) for rows in ([positive] * len(turned), turned))
        turned = turned[looks_mirrored(first, others, torch.tensor(faces)).numpy()]
        if len(turned):
            few, many = sorted((positive, int(turned[volumes[turned].argmin()])))
            raise MeshError(
                f"key-frame {many} is mirrored: its faces wind the other way round than in key-frame "
                f"{few}, seen from outside, and no motion without passing through itself leads from one to the "
                "other; mirror it back (negate one coordinate)"
            )


def _flaws(scaled: FloatArray, mesh: Connectivity, resolution: float) -> list[str]:
    """Messages on flaws that the solver tolerates, empty for those that the shapes do not have."""
    edges, boundary = mesh.edges, mesh.boundary_edges
    along = scaled[:, edges[:, 0]] - scaled[:, edges[:, 1]]
    # Rendering formats create coincident vertices at texture seams.
    copies = np.unique(scaled[0][np.unique(boundary)], axis=0, return_counts=True)[1]
    split = int(copies[copies > 1].sum())
    seam = f"; {split} of its vertices lie exactly on each other, perhaps a seam: torch_modal.weld_seams joins them"
    return [
        _count(
            np.argwhere(np.einsum("kei,kei->ke", along, along) <= resolution**2),
            "edges have no length, their two vertices coincide",
            lambda k, e: f"edge {edges[e].tolist()} in key-frame {k}",
        ),
        _count(
            np.argwhere([inspect.fatness(shape, mesh.faces) <= resolution for shape in scaled]),
            "faces have no area in some key-frame, so their dihedral angles are noise",
            lambda k, f: f"face {mesh.faces[f].tolist()} in key-frame {k}",
        ),
        _count(
            np.argwhere(mesh.counts > 2),
            "edges join three or more faces (non-manifold): they resist stretching but not bending",
            lambda e: f"edge {edges[e].tolist()}",
        ),
        _count(
            np.setdiff1d(np.arange(mesh.n_vertices), mesh.used)[:, None],
            "vertices belong to no face: they follow the interpolation of the key-frames",
            lambda v: f"vertex {v}",
        ),
        _count(
            np.argwhere(mesh.counts == 1),
            "edges belong to one face only: the surface is open",
            lambda e: f"edge {edges[e].tolist()}{seam if split else ''}",
        ),
    ]
