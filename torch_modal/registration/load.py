"""Key-frames from files."""

import os
import warnings
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch

from torch_modal.errors import MeshError, MeshWarning
from torch_modal.io.read import open_asset, require_same_mesh
from torch_modal.keyframes.check import Keyframes
from torch_modal.progress import Progress
from torch_modal.registration.landmarks import Landmarks, landmark_table

ADVICE = (
    "give landmarks, five or more: a text file with a line for each, which names one vertex of each mesh, counted from "
    "0 (--landmarks FILE); `torch-modal view MESH MESH --landmarks` opens a page to pick them on"
)


def load_keyframes(
    paths: Sequence[str | os.PathLike[str]],
    *,
    register: bool = False,
    landmarks: Landmarks = None,
    same_subject: bool = True,
    cache_dir: str | os.PathLike[str] | None = None,
    cache: bool = True,
    progress: Progress = None,
    report: Callable[[str], None] = lambda line: None,
) -> Keyframes:
    """Read key-frames from files, see :func:`torch_modal.open_asset`.

    Vertices keep their order. Faces may differ between the files in order, first corner and winding; the faces of the
    first file are used. `check_keyframes` reports flaws of the meshes.

    With ``register``, the meshes may have any connectivity: the first one is registered to each, from its predecessor.
    A mesh with the connectivity of the first is not registered.

    Args:
        paths: One file per key-frame, in the order of the sequence.
        register: Register meshes of another connectivity, see :func:`torch_modal.register`.
        landmarks: For the registration: a landmark file, vertices ``(n, K)``, or points ``(n, K, 3)``, a column for
            each of the K meshes.
        same_subject: True for poses of one body; different bodies may need five landmarks or more.
        cache_dir: Folder of the cache; by default ``TORCH_MODAL_CACHE`` or the user's cache folder.
        cache: Keep registrations on disk, and find them there.
        progress: Progress of registrations, see :data:`torch_modal.progress.Progress`.
        report: Called with a line about each registration.

    Returns:
        Positions, float64, *shape* ``(K, V, 3)``, in the files' units; faces, int64, *shape* ``(F, 3)``.

    Raises:
        FileNotFoundError: A file does not exist.
        MeshError: A file cannot be read, or differs from the first in its number of vertices or in its faces; or,
            with ``register``, a registration is doubtful.
        MissingPackageError: With ``register``, or of VTK files, an extra is not installed.

    Warns:
        MeshWarning: A file has a skeleton, animations or morph targets.
    """
    if isinstance(paths, (str, bytes, os.PathLike)):
        raise MeshError(f"paths is one path, {os.fspath(paths)!r}; pass a list with one file per key-frame")
    paths = list(paths)
    if not paths:
        raise MeshError("paths is empty; pass one file per key-frame")
    if (landmarks is not None or not same_subject) and not register:
        raise MeshError("landmarks and different subjects are for registration: ask for it too (--register)")
    meshes, posed = [], []
    for asset in map(open_asset, paths):
        meshes.append((asset.positions, asset.faces))
        posed += [f"{asset.path} has {asset.carries['posing']}"] if "posing" in asset.carries else []
    if posed:
        text = f"{posed[0]}: the shape at rest is read, so bake the pose to have it ({len(posed)} such key-frames)"
        warnings.warn(text, MeshWarning, stacklevel=2)
    marks = landmark_table(landmarks, [vertices for vertices, _ in meshes])
    vertices, faces = meshes[0]
    shapes = [vertices]
    for k, (there, there_faces) in enumerate(meshes[1:], 1):
        try:
            require_same_mesh(paths[0], meshes[0], paths[k], (there, there_faces))
            shapes.append(there)
            continue
        except MeshError:
            if not register:
                raise
        from torch_modal.registration.register import register as register_pair

        onto = partial(register_pair, same_subject=same_subject, cache_dir=cache_dir, cache=cache, progress=progress)
        result = onto(shapes[-1], faces, there, there_faces, landmarks=marks[:, k - 1 : k + 1])
        name, origin = os.fspath(paths[k]), os.fspath(paths[k - 1])
        report(f"{name} registered from {origin}: {result.summary()}")
        if result.doubtful:
            raise MeshError(
                f"the registration of {name} from {origin} is doubtful: {result.summary()}; "
                f"{'; '.join(result.warnings)}. To help it, {ADVICE}"
            )
        shapes.append(result.positions.numpy())
    return Keyframes(torch.from_numpy(np.stack(shapes)), torch.from_numpy(faces))
