"""Key-frame sets with their bases on disk: one folder each, written whole, read by memory mapping.

A folder holds ``keyframes.safetensors`` (``keyframes``, ``faces``; in its metadata the names of the source files, and
the times if the key-frames are a motion) and ``bases.safetensors``, where the tensors of each
:class:`~torch_modal.ModalBasis` have the number of the key-frame and a dot before their names. Other files in it,
``labels.safetensors`` for example, are the user's.
"""

import contextlib
import errno
import os
import re
import shutil
import stat
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torch_modal.data.motion import Motion
from torch_modal.io.tensors import TensorFile, write_tensors
from torch_modal.precompute.basis import FORMAT as BASIS_FORMAT
from torch_modal.precompute.basis import VERSION as BASIS_VERSION
from torch_modal.precompute.basis import ModalBasis

FORMAT = "torch_modal.set"
VERSION = "2"
KEYFRAMES_FILE = "keyframes.safetensors"
BASES_FILE = "bases.safetensors"
LABELS_FILE = "labels.safetensors"
#: How the set was made, if ``torch-modal precompute`` made it.
RECORD_FILE = "precompute.json"
#: Derived from a set and stored beside it; removed when the set is replaced.
DERIVED_FILES = "between-*.safetensors"
STALE = 86400.0
"""Age in seconds after which a temporary folder is abandoned."""
_PARTS = tuple(field.name for field in fields(ModalBasis))


class StoredSet:
    """A key-frame set on disk. Opening reads two headers; each tensor is memory-mapped at first use.

    It is then compared with its digest. The mapping is private: the system can drop pages, and writing into a tensor
    does not change the file. Pickling keeps the path alone, so that worker processes, forked or spawned, can receive a
    set.

    Args:
        folder: The folder.

    Raises:
        FileNotFoundError: The folder or one of its two files is not there.
        ValueError: A file is damaged, holds something else, or has another format version.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        file = self._keyframes_file()
        meta, shapes = file.metadata, file.shapes
        self._shape = shapes["keyframes"]
        if len(self._shape) != 3 or self._shape[2] != 3 or len(shapes["faces"]) != 2 or shapes["faces"][1] != 3:
            raise ValueError(f"{self.folder / KEYFRAMES_FILE} needs keyframes (K, V, 3) and faces (F, 3); has {shapes}")
        #: Names of the source files, one for each key-frame.
        self.names: tuple[str, ...] = tuple(meta["names"])
        #: When the key-frames are, if they are a motion; if cyclic, with the time when the first comes again.
        self.times: tuple[float, ...] | None = meta["times"] and tuple(meta["times"])
        self._bases_file()  # checks its header

    def _keyframes_file(self) -> TensorFile:
        return TensorFile(self.folder / KEYFRAMES_FILE, FORMAT, VERSION, ("keyframes", "faces"))

    def _bases_file(self) -> TensorFile:
        wanted = [f"{i}.{part}" for i in range(len(self)) for part in _PARTS]
        return TensorFile(self.folder / BASES_FILE, BASIS_FORMAT, BASIS_VERSION, wanted)

    def __len__(self) -> int:
        """Number of key-frames, K."""
        return self._shape[0]

    @property
    def n_vertices(self) -> int:
        """Number of vertices, V."""
        return self._shape[1]

    @property
    def cyclic(self) -> bool:
        """Whether the key-frames are a motion whose last leads on to the first."""
        return self.times is not None and len(self.times) == len(self) + 1

    @cached_property
    def keyframes(self) -> Tensor:
        """Vertex positions, float64. *Shape:* ``(K, V, 3)``."""
        return self._keyframes_file().tensor("keyframes")

    @cached_property
    def faces(self) -> Tensor:
        """Vertex indices, int64. *Shape:* ``(F, 3)``."""
        return self._keyframes_file().tensor("faces")

    @cached_property
    def bases(self) -> list[ModalBasis]:
        """The basis of each key-frame."""
        file = self._bases_file()
        return [ModalBasis(**{part: file.tensor(f"{i}.{part}") for part in _PARTS}) for i in range(len(self))]

    def __getstate__(self) -> dict[str, Any]:
        return {name: self.__dict__[name] for name in ("folder", "names", "times", "_shape")}

    def __repr__(self) -> str:
        return f"StoredSet({str(self.folder)!r}, {len(self)} key-frames, {self.n_vertices} vertices)"


def open_set(folder: str | os.PathLike[str]) -> StoredSet:
    """The key-frame set in a folder; see :class:`StoredSet`."""
    return StoredSet(folder)


def write_set(
    folder: str | os.PathLike[str],
    keyframes: Tensor,
    faces: Tensor,
    bases: Sequence[ModalBasis],
    names: Sequence[str],
    *,
    times: Tensor | Sequence[float] | None = None,
    cyclic: bool = False,
    beside: Mapping[str, bytes] | None = None,
) -> None:
    """Write a key-frame set; its folder is whole or absent.

    The files are written to a temporary folder beside it, which is then renamed. An existing set is replaced,
    and its derived tables are removed; all other files in its folder stay. Of several processes that write one set at
    once, the last one wins.

    Args:
        folder: The folder; its parents are created.
        keyframes: Vertex positions. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        bases: The basis of each key-frame.
        names: Name of each key-frame, for example its file's.
        times: Of the key-frames, ascending, if they are a motion; if cyclic, one more, at which the first
            repeats. *Shape:* ``(K,)``, or ``(K + 1,)`` if cyclic.
        cyclic: Whether the last key-frame of the motion leads on to the first.
        beside: Name and content of further files of the folder.

    Raises:
        FileExistsError: The folder holds something else.
        OSError: It cannot be written. Nothing is left behind.
        ValueError: The parts do not fit each other.
    """
    folder = Path(folder)
    _check_parts(keyframes, faces, bases, names)
    motion = Motion.of(times, len(keyframes), cyclic)
    if obstacle := why_not_replaceable(folder):
        raise FileExistsError(f"{obstacle}; move it away or write elsewhere")
    folder.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale(folder)
    mark = f"{os.getpid()}-{uuid.uuid4().hex[:8]}"
    fresh, old = (folder.with_name(f".{folder.name}.{mark}.{end}") for end in ("tmp", "old.tmp"))
    try:
        fresh.mkdir()
        metadata = {"names": list(map(str, names)), "times": None if motion is None else motion.times.tolist()}
        shapes = {"keyframes": keyframes.to(torch.float64), "faces": faces.to(torch.int64)}
        write_tensors(fresh / KEYFRAMES_FILE, FORMAT, VERSION, shapes, metadata)
        parts = {f"{i}.{part}": getattr(basis, part) for i, basis in enumerate(bases) for part in _PARTS}
        write_tensors(fresh / BASES_FILE, BASIS_FORMAT, BASIS_VERSION, parts)
        for name, content in (beside or {}).items():
            (fresh / name).write_bytes(content)
        _put_in_place(fresh, folder, old)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def why_not_replaceable(folder: Path) -> str:
    """Why a set cannot be written to a folder; empty if it can."""
    while os.path.lexists(folder):
        if folder.is_symlink() and not folder.exists():
            return f"{folder} is a link to nothing"
        try:
            found = folder.stat()
            if not stat.S_ISDIR(found.st_mode):
                return f"{folder} exists and is no folder"
            obstacle = _obstacle(folder)
            if not obstacle or folder.stat().st_ino == found.st_ino:
                return obstacle
        except FileNotFoundError:
            pass  # another process is replacing it at this moment: look again
    return ""


def _obstacle(folder: Path) -> str:
    there = sorted(folder.iterdir())
    if below := [path.name for path in there if path.is_dir()]:
        return f"{folder} holds the folder {below[0]}, which is no part of a stored key-frame set"
    if there and not {path.name for path in there} & {KEYFRAMES_FILE, BASES_FILE, LABELS_FILE, RECORD_FILE}:
        return f"{folder} holds {there[0].name} and no stored key-frame set"
    return ""


def _put_in_place(fresh: Path, folder: Path, old: Path) -> None:
    """Rename a complete folder to its place, with the user's files of the one that was there."""
    while True:
        try:
            with contextlib.suppress(FileNotFoundError):  # missing, or another process is replacing it too
                folder.rename(old)
                _keep_users_files(old, fresh)
            fresh.rename(folder)
            return
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                continue  # another process was faster; its set is the older one now
            if old.exists():
                old.rename(folder)
            raise
        finally:
            shutil.rmtree(old, ignore_errors=True)


def _keep_users_files(old: Path, fresh: Path) -> None:
    own = {KEYFRAMES_FILE, BASES_FILE, RECORD_FILE}
    for path in old.iterdir():
        if path.name in own or path.match(DERIVED_FILES) or path.match(".*.tmp") or (fresh / path.name).exists():
            continue
        try:  # a hard link, so that the file is in one of the folders at any time
            os.link(path, fresh / path.name, follow_symlinks=False)
        except (OSError, NotImplementedError):
            shutil.copy2(path, fresh / path.name, follow_symlinks=False)


def _remove_stale(folder: Path) -> None:
    """Remove temporary folders of killed processes; other files stay."""
    mark = re.compile(rf"\.{re.escape(folder.name)}\.\d+-[0-9a-f]{{8}}\.tmp")
    for path in folder.parent.iterdir():
        with contextlib.suppress(OSError):
            if mark.fullmatch(path.name) and time.time() - path.stat().st_mtime > STALE:
                shutil.rmtree(path, ignore_errors=True)


def find_sets(root: str | os.PathLike[str]) -> list[Path]:
    """Folders of stored key-frame sets at and below a folder, sorted. Skips hidden folders.

    Raises:
        FileNotFoundError: There is no such folder.
    """
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"there is no folder {root}")
    found = []
    for place, below, files in os.walk(root):
        if {KEYFRAMES_FILE, BASES_FILE} <= set(files):
            found.append(Path(place))
        below[:] = [name for name in below if not name.startswith(".")]
    return sorted(found)


def _check_parts(keyframes: Tensor, faces: Tensor, bases: Sequence[ModalBasis], names: Sequence[str]) -> None:
    shape = tuple(keyframes.shape)
    if len(shape) != 3 or shape[2] != 3 or not shape[0]:
        raise ValueError(f"keyframes have the shape {shape}; a set needs (K, V, 3)")
    if faces.dim() != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces have the shape {tuple(faces.shape)}; a set needs (F, 3)")
    sizes = [basis.n_vertices for basis in bases]
    if sizes != [shape[1]] * shape[0] or len(names) != shape[0]:
        raise ValueError(
            f"{shape[0]} key-frames of {shape[1]} vertices need as many bases and names; got bases of {sizes} vertices "
            f"and {len(names)} names"
        )
