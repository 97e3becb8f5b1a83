"""Key-frame sets with their bases on disk: a file in a folder for each set, written whole, read by memory mapping.

``set.safetensors`` holds ``keyframes``, ``faces`` and the tensors of each :class:`~torch_modal.ModalBasis`, with the
number of the key-frame and a dot before their names. Its metadata has the names of the source files, and the times if
the key-frames are a motion. Other files in the folder are the user's.
"""

import os
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from torch import Tensor

from torch_modal.autograd import outside_inference_mode
from torch_modal.io.tensors import TensorFile, write_tensors
from torch_modal.modes.basis import ModalBasis
from torch_modal.times import Times, check_times

FORMAT = "torch_modal.set"
VERSION = "2"
SET_FILE = "set.safetensors"
#: Tables of in-betweens, which follow from a set and are removed when it is replaced.
TABLE_FILES = "between-*.safetensors"
_BASIS_FIELDS = tuple(field.name for field in fields(ModalBasis))


class StoredSet:
    """A key-frame set on disk, mapped into memory and compared with its digests.

    The mapping is private: the system can drop pages, and writing into a tensor does not change the file.

    Args:
        folder: The folder.

    Attributes:
        folder: The folder.
        names: Names of the source files, one for each key-frame.
        keyframes: Vertex positions, float64. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices, int64. *Shape:* ``(F, 3)``.
        bases: The basis of each key-frame.
        times: Times of the key-frames, if they are a motion; if cyclic, with the time when the first comes again.
        note: Text of the program that made the set.

    Raises:
        FileNotFoundError: The folder or its file is not there.
        ValueError: The file is damaged, holds something else, or has another format version.
    """

    @outside_inference_mode
    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        file = _open_file(self.folder)
        self.names: tuple[str, ...] = tuple(file.metadata["names"])
        self.times: tuple[float, ...] | None = file.metadata["times"] and tuple(file.metadata["times"])
        self.note: str = file.metadata["note"]
        self.keyframes, self.faces = file.tensor("keyframes"), file.tensor("faces")
        places = range(len(self.keyframes))
        self.bases = [ModalBasis(**{name: file.tensor(f"{i}.{name}") for name in _BASIS_FIELDS}) for i in places]

    def __len__(self) -> int:
        """Number of key-frames, K."""
        return len(self.keyframes)

    @property
    def n_vertices(self) -> int:
        """Number of vertices, V."""
        return self.keyframes.shape[1]

    @property
    def cyclic(self) -> bool:
        """True if the key-frames are a motion whose last leads on to the first."""
        return self.times is not None and len(self.times) == len(self) + 1


def read_note(folder: Path) -> str:
    """Note of a stored set, from the header of its file alone; raises as :class:`StoredSet`."""
    return str(_open_file(folder).metadata["note"])


def write_set(
    folder: str | os.PathLike[str],
    keyframes: Tensor,
    faces: Tensor,
    bases: Sequence[ModalBasis],
    names: Sequence[str],
    *,
    times: Tensor | Sequence[float] | None = None,
    cyclic: bool = False,
    note: str = "",
) -> None:
    """Write a key-frame set; its file is whole or absent.

    An existing set is replaced, and the tables of its in-betweens are removed; all other files in its folder stay. Of
    several processes that write one set at once, the last one wins.

    Args:
        folder: The folder; it is created with its parents.
        keyframes: Vertex positions. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        bases: The basis of each key-frame.
        names: Name of each key-frame, for example its file's.
        times: Of the key-frames, ascending, if they are a motion; if cyclic, one more, at which the first
            repeats. *Shape:* ``(K,)``, or ``(K + 1,)`` if cyclic.
        cyclic: Whether the last key-frame of the motion leads on to the first.
        note: Any text, for :attr:`StoredSet.note`.

    Raises:
        OSError: The file cannot be written. Nothing is left behind.
        ValueError: Shapes of the arguments do not fit each other.
    """
    sizes = [tuple(basis.reference.shape) for basis in bases]
    if sizes != [tuple(x.shape) for x in keyframes] or len(names) != len(sizes) or faces.shape[1:] != (3,):
        raise ValueError(
            f"a set needs keyframes (K, V, 3), faces (F, 3), and a basis and a name of each key-frame; got "
            f"{tuple(keyframes.shape)}, {tuple(faces.shape)}, bases of {sizes} and {len(names)} names"
        )
    motion = motion_times(times, len(keyframes), cyclic)
    tensors = {"keyframes": keyframes.double(), "faces": faces.long()}
    for i, basis in enumerate(bases):
        tensors |= {f"{i}.{name}": getattr(basis, name) for name in _BASIS_FIELDS}
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    motion_seconds = None if motion is None else motion.tolist()
    metadata = {"names": [str(name) for name in names], "times": motion_seconds, "note": note}
    write_tensors(folder / SET_FILE, FORMAT, VERSION, tensors, metadata)
    for table in folder.glob(TABLE_FILES):
        table.unlink(missing_ok=True)


def find_sets(root: str | os.PathLike[str]) -> list[Path]:
    """Folders of stored key-frame sets at and below a folder, sorted. Skips hidden folders.

    Raises:
        FileNotFoundError: There is no such folder.
    """
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"there is no folder {root}")
    folders = [file.parent for file in root.rglob(SET_FILE)]
    return sorted(path for path in folders if not any(name[0] == "." for name in path.relative_to(root).parts))


def motion_times(times: Times, n_keyframes: int, cyclic: bool) -> Tensor | None:
    """Times of key-frames, if they are a motion; of a cycle even ones by default. Raises as :func:`check_times`."""
    return None if times is None and not cyclic else check_times(times, n_keyframes, cyclic)


def _open_file(folder: Path) -> TensorFile:
    """Open the file of a set and check its header; raises as :class:`StoredSet`."""
    return TensorFile(folder / SET_FILE, FORMAT, VERSION, ("keyframes", "faces"))
