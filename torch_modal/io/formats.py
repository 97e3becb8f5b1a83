"""Output formats by suffix. A format is one function that registers itself.

Modules of built-in formats are imported when their format is first used, so that listing formats costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

if TYPE_CHECKING:  # at run time NumPy stays out: the command line lists formats in its help
    from torch_modal.arrays import FloatArray, IntArray
    from torch_modal.io.asset import Asset
    from torch_modal.io.timing import Timing
    from torch_modal.progress import Progress

Writer = TypeVar("Writer", bound=Callable[..., Any])


class Animation(NamedTuple):
    """A sequence to write, as :func:`torch_modal.save_animation` passes it to a format."""

    shapes: FloatArray
    """*Shape:* ``(N, V, 3)``."""
    faces: IntArray
    """*Shape:* ``(F, 3)``."""
    timing: Timing
    """Times of the frames in seconds, and samples at a fixed rate."""
    name: str
    """Of the file, for messages."""
    keyframes: list[int]
    """Frame numbers of the key-frames."""
    asset: Asset | None
    """The mesh file that the frames come from."""
    max_targets: int
    """Most morph targets of a GLB."""
    progress: Progress


class MeshFormat(NamedTuple):
    """A format of one shape."""

    to_bytes: Callable[[FloatArray, IntArray, Any], bytes]
    holds: Collection[str]


class AnimationFormat(NamedTuple):
    """A format of a sequence."""

    write: Callable[[Animation, Path], None]
    modules: tuple[str, ...]
    extra: str


MESH_FORMATS: dict[str, MeshFormat | str] = {
    ".ply": "torch_modal.io.bare_mesh",
    ".obj": "torch_modal.io.bare_mesh",
    ".off": "torch_modal.io.bare_mesh",
    ".glb": "torch_modal.io.glb",
}
ANIMATION_FORMATS: dict[str, AnimationFormat | str] = {
    ".glb": "torch_modal.io.glb",
    ".mp4": "torch_modal.view.video",
    ".gif": "torch_modal.view.video",
    ".usd": "torch_modal.io.usd",
    ".usda": "torch_modal.io.usd",
    ".usdc": "torch_modal.io.usd",
    ".mdd": "torch_modal.io.point_cache",
    ".pc2": "torch_modal.io.point_cache",
    ".npz": "torch_modal.io.point_cache",
}
"""Each format, or the module that registers it."""


def mesh_format(suffix: str, holds: Collection[str] = ()) -> Callable[[Writer], Writer]:
    """Register a function that writes one shape, for :func:`torch_modal.save_frames`.

    The function takes vertices ``(V, 3)``, faces ``(F, 3)`` and the :class:`torch_modal.Asset` that they come from, or
    None, and returns the bytes of the file.

    Args:
        suffix: In small letters with its dot, such as ``".xyz"``.
        holds: Which of :data:`torch_modal.io.asset.FEATURES` it takes from the asset; of others a warning says that
            they are lost.
    """

    def register(to_bytes: Writer) -> Writer:
        MESH_FORMATS[suffix] = MeshFormat(to_bytes, holds)
        return to_bytes

    return register


def animation_format(*suffixes: str, modules: tuple[str, ...] = (), extra: str = "") -> Callable[[Writer], Writer]:
    """Register a function that writes a sequence, for :func:`torch_modal.save_animation`.

    The function takes an :class:`torch_modal.Animation` and the path of a new file, which is moved to its place when
    the function returns.

    Args:
        suffixes: In small letters with their dots, such as ``".csv"``.
        modules: What must be installed.
        extra: The extra of torch_modal that installs it.
    """

    def register(write: Writer) -> Writer:
        ANIMATION_FORMATS.update(dict.fromkeys(suffixes, AnimationFormat(write, modules, extra)))
        return write

    return register


def find_mesh_format(suffix: str) -> MeshFormat:
    """The format of a suffix."""
    found = MESH_FORMATS[suffix]
    if isinstance(found, str):
        import_module(found)
        return find_mesh_format(suffix)
    return found


def find_animation_format(suffix: str) -> AnimationFormat:
    """The format of a suffix."""
    found = ANIMATION_FORMATS[suffix]
    if isinstance(found, str):
        import_module(found)
        return find_animation_format(suffix)
    return found
