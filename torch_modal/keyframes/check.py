"""Checks of key-frames: all errors and warnings about the input.

``docs/input.md`` lists the conditions. Messages count key-frames, vertices and faces from 0.
"""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from torch_modal.arrays import FloatArray, IntArray
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


def check_keyframes(keyframes: Any, faces: Any, *, min_keyframes: int = 1, warn: bool = True) -> Keyframes:
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
    flaws: list[str] = []
    positions, mesh = check_surface(keyframes, faces, min_keyframes, flaws if warn else None)
    for message in flaws:
        warnings.warn(message, MeshWarning, stacklevel=2)
    return Keyframes(positions, torch.tensor(mesh.faces, device=positions.device))


def check_surface(
    keyframes: Any, faces: Any, min_keyframes: int = 1, flaws: list[str] | None = None
) -> tuple[torch.Tensor, Connectivity]:
    """`check_keyframes` that returns the connectivity instead of the faces, and appends flaws to a list, if given."""
    positions, shapes, indices = check_arrays(keyframes, faces, min_keyframes)
    notes: list[str] = [] if flaws is None else flaws
    mesh, orientable = _repair(indices, shapes.shape[1], notes.append)
    scaled = _check_sizes(shapes, mesh, positions.dtype, notes.append)
    if orientable and not (mesh.counts % 2).any():
        _refuse_mirrored(scaled, mesh.faces)
    if flaws is not None:
        same = np.flatnonzero((shapes[1:] == shapes[:-1]).all(axis=(1, 2))) + 1
        if len(same):
            flaws.append(f"{len(same)} key-frames are equal to the one before; the first is key-frame {same[0]}")
        _note_flaws(scaled, mesh, _RESOLUTION[positions.dtype], notes.append)
    return positions, mesh


def check_arrays(keyframes: Any, faces: Any, min_keyframes: int = 1) -> tuple[torch.Tensor, FloatArray, IntArray]:
    """Check shapes and values of the arrays; return positions, unchanged and in float64, and faces.

    Raises:
        MeshError: Wrong shapes, values that are not finite, or invalid indices.
    """
    positions, indices = as_positions(keyframes), as_faces(faces)
    shape = tuple(positions.shape)
    if len(shape) == 2 and shape[1] == 3:
        raise MeshError(f"keyframes have shape {shape}, which is one shape; pass keyframes[None] for (K, V, 3)")
    if len(shape) != 3 or shape[2] != 3:
        raise MeshError(f"keyframes have shape {shape}; (K, V, 3) is needed: key-frames, vertices, coordinates")
    if shape[0] < max(min_keyframes, 1):
        raise MeshError(f"{shape[0]} key-frame(s) arrived, at least {max(min_keyframes, 1)} are needed")
    if shape[1] == 0:
        raise MeshError(f"keyframes have shape {shape}: there are no vertices")
    if indices.ndim == 2 and indices.shape[1] == 4:
        raise MeshError(
            f"faces have shape {indices.shape}, which is quads (or tetrahedra); triangles (F, 3) are needed: "
            "cut each quad along one diagonal, the same for all key-frames"
        )
    if indices.size == 0:
        raise MeshError(f"faces have shape {indices.shape}: there are no faces; key-frames are surfaces of triangles")
    if indices.ndim != 2 or indices.shape[1] != 3:
        raise MeshError(f"faces have shape {indices.shape}; (F, 3) is needed, one for all key-frames")
    shapes = positions.detach().cpu().double().resolve_neg().numpy()
    finite = np.isfinite(shapes)
    if not finite.all():
        bad = ~finite.all(axis=2)
        k, v = np.argwhere(bad)[0]
        raise MeshError(
            f"{bad.sum()} vertices have NaN or infinite positions; the first is vertex {v} of key-frame {k}: "
            f"{shapes[k, v].tolist()}"
        )
    if indices.min() < 0 or indices.max() >= shape[1]:
        wrong = ((indices < 0) | (indices >= shape[1])).any(axis=1)
        face = int(np.flatnonzero(wrong)[0])
        hint = "; indices count from 0, not from 1" if indices.min() == 1 and indices.max() == shape[1] else ""
        raise MeshError(
            f"{wrong.sum()} faces use vertices that do not exist; the first is face {face}, vertices "
            f"{indices[face].tolist()}, with {shape[1]} vertices{hint}"
        )
    return positions, shapes, indices


def _repair(faces: IntArray, n_vertices: int, note: Callable[[str], None]) -> tuple[Connectivity, bool]:
    """Drop degenerate and repeated faces, orient the others; return the mesh and its orientability."""
    kept = np.arange(len(faces))
    for flaw, what in (
        (inspect.degenerate_faces, "use a vertex twice"),
        (inspect.repeated_faces, "have the same vertices as an earlier face"),
    ):
        bad = flaw(faces[kept])
        if bad.any():
            first = kept[bad][0]
            note(f"{bad.sum()} faces {what} and were dropped; the first is face {first}, {faces[first].tolist()}")
            kept = kept[~bad]
        if len(kept) == 0:
            raise MeshError("all faces use a vertex twice, so none is a triangle")
    mesh = Connectivity(faces[kept], n_vertices)
    wound, flipped, non_orientable = inspect.consistent_winding(mesh)
    if len(flipped):
        first = kept[flipped[0]]
        note(
            f"{len(flipped)} faces wind against their neighbours and were turned over; the first is "
            f"face {first}, {faces[first].tolist()}"
        )
    if len(non_orientable):
        first = kept[non_orientable[0]]
        note(
            f"{len(non_orientable)} faces belong to a surface that has no consistent winding (like a "
            "Moebius strip) and were left as they are, so some dihedral angles have the wrong sign and the "
            f"volume means nothing; the first is face {first}, {faces[first].tolist()}"
        )
    if len(flipped):
        mesh = Connectivity(wound, n_vertices)
    return mesh, not len(non_orientable)


def _check_sizes(shapes: FloatArray, mesh: Connectivity, dtype: torch.dtype, note: Callable[[str], None]) -> FloatArray:
    """Reject unusable sizes; return centred shapes with a diagonal of 1."""
    surface = shapes[:, mesh.used]
    with np.errstate(over="ignore", invalid="ignore"):
        diagonals = inspect.diagonals(surface)
    low, high = _DIAGONAL_RANGE[dtype]
    far = []
    for k, diagonal in enumerate(diagonals):
        largest = np.abs(surface[k]).max()
        if torch.finfo(dtype).eps * largest > _COARSE_ROUNDING * diagonal:
            far.append((k, largest, diagonal))
        if diagonal <= _RESOLUTION[dtype] * largest:
            raise MeshError(
                f"key-frame {k} has zero size: its bounding-box diagonal is {diagonal:.3g} at coordinates up "
                f"to {largest:.3g}, which {dtype} cannot resolve; move it to the origin or check its export"
            )
        if not low < diagonal < high:
            raise MeshError(
                f"key-frame {k} has a bounding-box diagonal of {diagonal:.3g}, which {dtype} cannot compute "
                "with; choose another unit"
            )
    if far:
        k, largest, diagonal = far[0]
        note(
            f"{len(far)} key-frames lie so far from the origin that {dtype} rounds their shape visibly; the "
            f"first is key-frame {k} with coordinates up to {largest:.3g} and a diagonal of {diagonal:.3g}: "
            "use float64, or move it to the origin"
        )
    small, large = int(diagonals.argmin()), int(diagonals.argmax())
    if diagonals[large] > _LARGEST_SIZE_RATIO * diagonals[small]:
        raise MeshError(
            f"key-frame {large} has a bounding-box diagonal of {diagonals[large]:.3g}, key-frame {small} one "
            f"of {diagonals[small]:.3g}: more than {_LARGEST_SIZE_RATIO:.0f} times as large; they are "
            "probably in different units, so scale one of them"
        )
    with np.errstate(over="ignore"):  # unreferenced vertices, which are not used below
        return (shapes - surface.mean(axis=1, keepdims=True)) / diagonals[:, None, None]


def _refuse_mirrored(scaled: FloatArray, faces: IntArray) -> None:
    """Reject closed meshes that are mirror images of each other. *Shape:* ``(K, V, 3), (F, 3)``."""
    volumes = np.array([inspect.signed_volume(shape, faces) for shape in scaled])
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


def _note_flaws(scaled: FloatArray, mesh: Connectivity, resolution: float, note: Callable[[str], None]) -> None:
    """Report flaws that the solver tolerates."""
    faces, edges, counts = mesh.faces, mesh.edges, mesh.counts
    along = scaled[:, edges[:, 0]] - scaled[:, edges[:, 1]]
    vanishing = np.einsum("kei,kei->ke", along, along) <= resolution**2
    if vanishing.any():
        k, e = np.argwhere(vanishing)[0]
        note(
            f"{vanishing.sum()} edges have no length, their two vertices coincide; the first is edge "
            f"{edges[e].tolist()} in key-frame {k}"
        )
    flat = np.stack([inspect.flat_faces(shape, faces, resolution) for shape in scaled])
    if flat.any():
        k, f = np.argwhere(flat)[0]
        note(
            f"{flat.sum()} faces have no area in some key-frame, so their dihedral angles are noise; the "
            f"first is face {faces[f].tolist()} in key-frame {k}"
        )
    overfull = edges[counts > 2]
    if len(overfull):
        note(
            f"{len(overfull)} edges join three or more faces (non-manifold): they resist stretching but not "
            f"bending; the first is edge {overfull[0].tolist()}"
        )
    loose = np.setdiff1d(np.arange(mesh.n_vertices), mesh.used)
    if len(loose):
        note(
            f"{len(loose)} vertices belong to no face: they follow the interpolation of the key-frames; the "
            f"first is vertex {loose[0]}"
        )
    boundary = mesh.boundary_edges
    if len(boundary):
        # Rendering formats create coincident vertices at texture seams.
        copies = np.unique(scaled[0][np.unique(boundary)], axis=0, return_counts=True)[1]
        split = int(copies[copies > 1].sum())
        seam = f"; {split} of its vertices lie exactly on each other, perhaps a seam: torch_modal.weld_seams joins them"
        note(
            f"the surface is open: {len(boundary)} edges belong to one face only, the first is edge "
            f"{boundary[0].tolist()}{seam if split else ''}"
        )
