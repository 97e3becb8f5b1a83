"""Output formats by suffix. A format is a function that registers itself.

Modules of built-in formats are imported when their format is first used, so that listing formats costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

if TYPE_CHECKING:  # at run time NumPy stays out: the command line lists formats in its help
    from torch_modal.arrays import FloatArray, IntArray
    from torch_modal.io.asset import Asset
    from torch_modal.io.timing import Timing
    from torch_modal.progress import Progress

Writer = TypeVar("Writer", bound=Callable[..., Any])


class OutputFormat(NamedTuple):
    """A registered function, with the arguments of its registration."""

    write: Callable[..., Any]
    holds: Collection[str] = ()
    modules: Collection[str] = ()
    extra: str = ""


MESH_FORMATS: dict[str, OutputFormat | str] = {
    **dict.fromkeys((".ply", ".obj", ".off"), "torch_modal.io.bare_mesh"),
    ".glb": "torch_modal.io.glb",
}
ANIMATION_FORMATS: dict[str, OutputFormat | str] = {
    ".glb": "torch_modal.io.glb",
    **dict.fromkeys((".mp4", ".gif"), "torch_modal.view.animation"),
    **dict.fromkeys((".usd", ".usda", ".usdc"), "torch_modal.io.usd"),
    **dict.fromkeys((".mdd", ".pc2", ".npz"), "torch_modal.io.point_cache"),
}
"""Each format, or the module that registers it."""


PICTURES = (".png", ".pdf")
PAGES = (".html", ".htm")


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
    """See :data:`torch_modal.progress.Progress`."""


def mesh_format(*suffixes: str, holds: Collection[str] = ()) -> Callable[[Writer], Writer]:
    """Register a function that writes one shape, for :func:`torch_modal.save_frames`.

    The function takes vertices ``(V, 3)``, faces ``(F, 3)`` and the :class:`torch_modal.Asset` that they come from, or
    None, and returns the bytes of the file.

    Args:
        suffixes: In small letters with their dots, such as ``".xyz"``.
        holds: Which of :data:`torch_modal.io.asset.FEATURES` it takes from the asset; a warning names the others.
    """
    return _registration(MESH_FORMATS, suffixes, holds=holds)


def animation_format(*suffixes: str, modules: Collection[str] = (), extra: str = "") -> Callable[[Writer], Writer]:
    """Register a function that writes a sequence, for :func:`torch_modal.save_animation`.

    The function takes an :class:`torch_modal.Animation` and the path of a new file, which is renamed when the
    function returns.

    Args:
        suffixes: In small letters with their dots, such as ``".csv"``.
        modules: What must be installed.
        extra: The extra of torch_modal that installs it.
    """
    return _registration(ANIMATION_FORMATS, suffixes, modules=modules, extra=extra)


def _registration(
    table: dict[str, OutputFormat | str], suffixes: tuple[str, ...], **options: Any
) -> Callable[[Writer], Writer]:
    def register(write: Writer) -> Writer:
        built_in = write.__module__.startswith("torch_modal.")
        for suffix in suffixes:
            if not built_in or not isinstance(table.get(suffix), OutputFormat):  # a user's format stays
                table[suffix] = OutputFormat(write, **options)
        return write

    return register


def find_format(table: dict[str, OutputFormat | str], suffix: str) -> OutputFormat:
    """The format of a suffix in one of the tables."""
    found = table[suffix]
    if isinstance(found, str):
        import_module(found)
        found = table[suffix]
    assert isinstance(found, OutputFormat)
    return found
