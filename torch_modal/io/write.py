"""A sequence of shapes on disk: numbered meshes, or one animated GLB.

Coordinates are written as the caller has them: nothing is centred, scaled or turned.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from torch_modal.io.files import write_atomically

if TYPE_CHECKING:  # at run time these stay out: a reader of PLY files needs neither
    import torch

    Array = torch.Tensor | NDArray[Any]

__all__ = ["save_animation", "save_frames"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CLAY = (0.66, 0.52, 0.42)  # linear RGB, the base colour of the GLB's material
# Normals double the file. Beyond this size (POSITION alone) they are left out.
LARGEST_FILE_WITH_NORMALS = 48 * 2**20


def to_numpy(array: Array) -> NDArray[Any]:
    """A torch tensor (any device, with or without gradient) or NumPy array as a NumPy array."""
    if hasattr(array, "detach"):
        tensor = array.detach().cpu()
        # NumPy has no bfloat16; float64 holds every torch float exactly.
        return (tensor.double() if tensor.is_floating_point() else tensor).numpy()
    return np.asarray(array)


def check_frames(frames: Array, faces: Array, name: str = "frames") -> tuple[FloatArray, IntArray]:
    """Shapes and faces as NumPy arrays, after the checks that every output needs.

    Args:
        frames: Vertex positions. *Shape:* ``(N, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        name: What the messages call ``frames``.

    Returns:
        ``frames`` as float64, ``faces`` as int64.

    Raises:
        ValueError: A shape is wrong, a value is not finite, or a face names a vertex that does not exist.
    """
    shapes, triangles = to_numpy(frames), to_numpy(faces)
    if shapes.ndim != 3 or shapes.shape[2] != 3 or 0 in shapes.shape:
        hint = "; one shape alone is frames[None]" if shapes.ndim == 2 else ""
        raise ValueError(f"{name} must have shape (N, V, 3) with N, V >= 1, got {shapes.shape}{hint}.")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or len(triangles) == 0:
        raise ValueError(f"faces must have shape (F, 3), triangles, with F >= 1, got {triangles.shape}.")
    if triangles.dtype.kind not in "iu":
        raise ValueError(f"faces must hold integers, got {triangles.dtype}.")
    if triangles.min() < 0 or triangles.max() >= shapes.shape[1]:
        raise ValueError(
            f"faces must index the {shapes.shape[1]} vertices of {name} from 0, "
            f"got indices from {triangles.min()} to {triangles.max()}."
        )
    shapes = shapes.astype(np.float64)
    # Every format but OBJ and OFF stores float32, where larger numbers become infinite.
    bad = ~(np.abs(shapes) <= np.finfo(np.float32).max).all(axis=(1, 2))
    if bad.any():
        raise ValueError(
            f"{name} must hold finite numbers within float32; {int(bad.sum())} of {len(shapes)} shapes "
            f"do not, the first is number {int(bad.argmax())}."
        )
    return shapes, triangles.astype(np.int64)


def check_indices(indices: Sequence[int], n_frames: int, name: str) -> list[int]:
    """Frame numbers, each once and in order; negative ones are refused, not wrapped."""
    numbers = sorted({int(index) for index in indices})
    if not numbers or numbers[0] < 0 or numbers[-1] >= n_frames:
        raise ValueError(
            f"{name} must be numbers of frames, from 0 to {n_frames - 1}, at least one; got {list(indices)}."
        )
    return numbers


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Raise before any work is done if ``path`` may not be written."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; name a file.")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists; pass overwrite=True (--overwrite) to replace it.")


def write_file(path: Path, data: bytes) -> None:
    """Write a whole file or nothing; its folder is made if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, data)


def vertex_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Unit normals, the mean over the faces around each vertex weighted by area.

    A vertex with no face, or whose faces cancel, gets ``(0, 0, 1)``: GLB demands unit length everywhere.

    Args:
        vertices: Vertex positions. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.

    Returns:
        Normals. *Shape:* ``(V, 3)``.
    """
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Scaled first, so that the squares of tiny shapes' areas do not underflow.
    face_normals /= max(float(np.abs(face_normals).max()), np.finfo(np.float64).tiny)
    corner_ids, repeated = faces.reshape(-1), np.repeat(face_normals, 3, axis=0)
    normals = np.stack([np.bincount(corner_ids, repeated[:, c], len(vertices)) for c in range(3)], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 1e-12, normals / np.maximum(length, 1e-12), np.array([0.0, 0.0, 1.0]))


def _ply_bytes(vertices: FloatArray, faces: IntArray) -> bytes:
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    return header.encode("ascii") + vertices.astype("<f4").tobytes() + rows.tobytes()


# In both text formats repr() gives the fewest digits that read back as the same float64.
def _obj_bytes(vertices: FloatArray, faces: IntArray) -> bytes:
    points = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist())
    return (points + "".join(f"f {a} {b} {c}\n" for a, b, c in (faces + 1).tolist())).encode("ascii")


def _off_bytes(vertices: FloatArray, faces: IntArray) -> bytes:
    points = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist())
    triangles = "".join(f"3 {a} {b} {c}\n" for a, b, c in faces.tolist())
    return f"OFF\n{len(vertices)} {len(faces)} 0\n{points}{triangles}".encode("ascii")


_WRITERS = {"ply": _ply_bytes, "obj": _obj_bytes, "off": _off_bytes}


def save_frames(
    frames: Array,
    faces: Array,
    out: str | Path,
    fmt: Literal["ply", "obj", "off"] = "ply",
    stem: str = "frame",
    overwrite: bool = False,
) -> list[Path]:
    """Write every shape as a mesh of its own: ``frame-000.ply``, ``frame-001.ply``, ...

    Vertices and faces keep their order. OBJ and OFF are text and hold float64 exactly; PLY is binary and
    holds float32 (about seven digits), which is what viewers expect: take OBJ where the files are computed
    with again.

    Args:
        frames: Vertex positions, in the caller's coordinates. *Shape:* ``(N, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        out: Folder; it is made if missing.
        fmt: ``"ply"``, ``"obj"`` or ``"off"``.
        stem: Start of the file names.
        overwrite: Replace files that exist. Files with other numbers, of a longer sequence, stay.

    Returns:
        The files, in the order of the frames.

    Raises:
        ValueError: ``frames``, ``faces``, ``fmt`` or ``stem`` cannot be used; the message says why.
        FileExistsError: One of the files exists and ``overwrite`` is off; then none is written.
        NotADirectoryError: ``out`` is a file.
    """
    shapes, triangles = check_frames(frames, faces)
    if fmt not in _WRITERS:
        raise ValueError(f"fmt must be one of {', '.join(_WRITERS)}, got {fmt!r}.")
    if not stem or Path(stem).name != stem:
        raise ValueError(f"stem must be the start of a file name, without folders, got {stem!r}.")
    folder = Path(out)
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"{folder} is a file; out must be a folder.")
    digits = max(3, len(str(len(shapes) - 1)))
    paths = [folder / f"{stem}-{number:0{digits}d}.{fmt}" for number in range(len(shapes))]
    for path in paths:
        refuse_existing(path, overwrite)
    for path, vertices in zip(paths, shapes, strict=True):
        write_file(path, _WRITERS[fmt](vertices, triangles))
    return paths


def save_mesh(vertices: Array, faces: Array, out: str | Path, overwrite: bool = False) -> Path:
    """Write one shape; the file's extension says the format, as for `save_frames`.

    Raises:
        ValueError: The arrays or the extension cannot be used.
        FileExistsError: The file exists and ``overwrite`` is off.
    """
    path = Path(out)
    shapes, triangles = check_frames(to_numpy(vertices)[None], faces, "vertices[None]")
    fmt = path.suffix.lower().lstrip(".")
    if fmt not in _WRITERS:
        raise ValueError(f"{path.name!r} must end in one of {', '.join('.' + name for name in _WRITERS)}.")
    refuse_existing(path, overwrite)
    write_file(path, _WRITERS[fmt](shapes[0], triangles))
    return path


def _thinned(n_frames: int, most: int, wanted: list[int]) -> IntArray:
    """At most ``most`` frame numbers, evenly spread, with both ends and (if they fit) the wanted ones."""
    if n_frames <= most:
        return np.arange(n_frames)
    fixed = sorted({0, n_frames - 1, *wanted})
    if len(fixed) > most:
        return np.unique(np.linspace(0, n_frames - 1, most).round().astype(np.int64))
    gaps, pieces = np.diff(fixed), np.ones(len(fixed) - 1, dtype=np.int64)
    for _ in range(most - len(fixed)):
        pieces[np.argmax(gaps / pieces)] += 1  # the widest step is shortened
    inside = [np.linspace(a, b, n + 1) for a, b, n in zip(fixed[:-1], fixed[1:], pieces, strict=True)]
    return np.unique(np.concatenate(inside).round().astype(np.int64))


class _Buffer:
    """The GLB's binary part while it grows; gives accessor numbers."""

    def __init__(self, gltf: Any) -> None:
        self.gltf = gltf
        self.data = bytearray()

    def add(self, array: NDArray[Any], kind: str, target: int | None = None, bounds: bool = False) -> int:
        """Append an array of float32 or unsigned integers as a view with one accessor."""
        import pygltflib as gl

        component = {"float32": gl.FLOAT, "uint16": gl.UNSIGNED_SHORT, "uint32": gl.UNSIGNED_INT}[str(array.dtype)]
        self.data += bytes(-len(self.data) % 4)  # views start at multiples of four bytes
        data = np.ascontiguousarray(array).tobytes()
        self.gltf.bufferViews.append(
            gl.BufferView(buffer=0, byteOffset=len(self.data), byteLength=len(data), target=target)
        )
        self.data += data
        rows = array.reshape(len(array), -1)
        self.gltf.accessors.append(
            gl.Accessor(
                bufferView=len(self.gltf.bufferViews) - 1,
                componentType=component,
                count=len(rows),
                type=kind,
                min=rows.min(axis=0).tolist() if bounds else None,
                max=rows.max(axis=0).tolist() if bounds else None,
            )
        )
        return len(self.gltf.accessors) - 1


def save_animation(
    frames: Array,
    faces: Array,
    out: str | Path,
    fps: float = 24.0,
    keyframe_indices: Sequence[int] | None = None,
    cyclic: bool = False,
    overwrite: bool = False,
    max_targets: int = 64,
) -> Path:
    """Write the sequence as one animated GLB (glTF 2.0): frame 0 and a morph target for each further frame.

    Viewers interpolate linearly between neighbouring frames. glTF calls Y up and metres the unit; the
    caller's coordinates are written as they are (float32), so a Z-up sequence lies on its back there. Normals
    are smooth and move with the shape, except where that would make a very large file (with a warning).

    Args:
        frames: Vertex positions, in the caller's coordinates. *Shape:* ``(N, V, 3)``. One shape gives a GLB
            that stands still.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        out: File to write, ``*.glb``.
        fps: Frames a second.
        keyframe_indices: Which frames are key-frames. They are kept when frames are left out (unless they are
            too many themselves), and named in the animation's ``extras``.
        cyclic: Add the step from the last frame back to the first, unless the two are equal already.
        overwrite: Replace the file if it exists.
        max_targets: Most morph targets. Players hold every target in memory, and the weights grow with their
            square; a longer sequence loses frames evenly, with a warning, and players fill in linearly.

    Returns:
        The file.

    Raises:
        ValueError: An argument cannot be used; the message says why.
        FileExistsError: The file exists and ``overwrite`` is off.
    """
    import pygltflib as gl

    shapes, triangles = check_frames(frames, faces)
    path = Path(out)
    if path.suffix.lower() != ".glb":
        raise ValueError(f"out must end in .glb, got {path.name!r}.")
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps must be a positive number, got {fps}.")
    if max_targets < 1:
        raise ValueError(f"max_targets must be at least 1, got {max_targets}.")
    refuse_existing(path, overwrite)
    keyframes = [] if keyframe_indices is None else check_indices(keyframe_indices, len(shapes), "keyframe_indices")

    close = cyclic and len(shapes) > 1 and not np.array_equal(shapes[0], shapes[-1])
    kept = _thinned(len(shapes), max_targets + 1, keyframes)
    if len(kept) < len(shapes):
        warnings.warn(
            f"{path.name} holds {len(kept)} of the {len(shapes)} frames (max_targets={max_targets}); "
            "players interpolate linearly between them.",
            stacklevel=2,
        )
    # Each kept frame shows fully at its time: one-hot rows of weights (times, targets), zeros for frame 0.
    times, weights = kept / fps, np.eye(len(kept))[:, 1:]
    if close:
        times, weights = np.append(times, len(shapes) / fps), np.vstack([weights, weights[:1]])
    move_normals = shapes[kept].size * 4 <= LARGEST_FILE_WITH_NORMALS
    if not move_normals:
        warnings.warn(f"{path.name} is large: its normals stay those of frame 0.", stacklevel=2)

    gltf = gl.GLTF2(asset=gl.Asset(version="2.0", generator="torch_modal"))
    buffer = _Buffer(gltf)
    base = shapes[0].astype(np.float32)
    normals = vertex_normals(shapes[0], triangles).astype(np.float32)
    attributes = gl.Attributes(
        POSITION=buffer.add(base, gl.VEC3, gl.ARRAY_BUFFER, bounds=True),
        NORMAL=buffer.add(normals, gl.VEC3, gl.ARRAY_BUFFER),
    )
    index_type = np.uint16 if shapes.shape[1] <= 65535 else np.uint32  # 65535 itself is not a valid uint16 index
    indices = buffer.add(triangles.astype(index_type).reshape(-1), gl.SCALAR, gl.ELEMENT_ARRAY_BUFFER)

    targets = []
    for number in kept[1:]:
        # Against the rounded base, so that its rounding is not carried into every frame.
        moved = (shapes[number] - base).astype(np.float32)
        target = {"POSITION": buffer.add(moved, gl.VEC3, gl.ARRAY_BUFFER, bounds=True)}
        if move_normals:
            turned = (vertex_normals(shapes[number], triangles) - normals).astype(np.float32)
            target["NORMAL"] = buffer.add(turned, gl.VEC3, gl.ARRAY_BUFFER)
        targets.append(target)

    gltf.materials = [
        gl.Material(
            name="clay",
            doubleSided=True,
            pbrMetallicRoughness=gl.PbrMetallicRoughness(
                baseColorFactor=[*CLAY, 1.0], metallicFactor=0.0, roughnessFactor=0.85
            ),
        )
    ]
    primitive = gl.Primitive(attributes=attributes, indices=indices, material=0, targets=targets or None)
    mesh = gl.Mesh(name=path.stem, primitives=[primitive])
    if targets:
        mesh.weights = [0.0] * len(targets)
        mesh.extras = {"targetNames": [f"frame-{number:03d}" for number in kept[1:]]}
        sampler = gl.AnimationSampler(
            input=buffer.add(times.astype(np.float32), gl.SCALAR, bounds=True),
            output=buffer.add(weights.astype(np.float32).reshape(-1), gl.SCALAR),
            interpolation=gl.ANIM_LINEAR,
        )
        channel = gl.AnimationChannel(sampler=0, target=gl.AnimationChannelTarget(node=0, path="weights"))
        extras = {"fps": float(fps), "frames": kept.tolist(), "keyframes": keyframes}
        gltf.animations = [gl.Animation(name="sequence", samplers=[sampler], channels=[channel], extras=extras)]
    gltf.meshes = [mesh]
    gltf.nodes = [gl.Node(name=path.stem, mesh=0)]
    gltf.scenes = [gl.Scene(name="scene", nodes=[0])]
    gltf.scene = 0
    gltf.buffers = [gl.Buffer(byteLength=len(buffer.data))]
    gltf.set_binary_blob(bytes(buffer.data))
    write_file(path, b"".join(gltf.save_to_bytes()))
    return path
