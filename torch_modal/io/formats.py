"""Output formats by suffix, and the data of an animation that they receive."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.extras import require
from torch_modal.io.asset import FEATURES, Asset
from torch_modal.progress import Progress
from torch_modal.times import check_times

if TYPE_CHECKING:
    from torch_modal.geometry.skin import Skin

FPS = 24.0
PIXELS = 640  # the longer side of a picture of a video


@dataclass(frozen=True)
class OutputFormat:
    """A function that writes a format, with what must be known before it is imported.

    In :data:`MESH_FORMATS`, for :func:`torch_modal.save_mesh`, it takes vertices ``(V, 3)``, faces ``(F, 3)`` and the
    :class:`torch_modal.io.asset.Asset` that they come from, or None, and returns the bytes of a file. In
    :data:`ANIMATION_FORMATS`, for :func:`torch_modal.save_animation`, it takes an :class:`Animation` and the path of a
    new file, which is renamed when the function returns.

    Attributes:
        function: The function; of built-in formats its place, ``module:name``.
        holds: Which of :data:`torch_modal.io.asset.FEATURES` it takes from an asset; a warning names the others.
        modules: Modules that must be installed.
        extra: The extra of torch_modal that installs them.
    """

    function: Callable[..., Any] | str
    holds: Collection[str] = ()
    modules: Collection[str] = ()
    extra: str = ""

    def check_installed(self, name: str) -> None:
        """Raise a MissingPackageError that names the file, before any work, if a module is not installed."""
        for module in self.modules:
            require(module, self.extra, name)

    def write(self, *arguments: Any) -> Any:
        """Call the function."""
        function = resolve_name(self.function) if isinstance(self.function, str) else self.function
        return function(*arguments)


GLB_HOLDS = ("texcoords", "normals", "colors", "materials")
"""From a file of another format; of materials, colour, roughness and the texture of the colour."""
USD_HOLDS = ("polygons", "texcoords", "normals", "colors", "materials")
MESH_FORMATS: dict[str, OutputFormat] = {
    ".ply": OutputFormat("torch_modal.io.ply:ply_bytes"),
    ".obj": OutputFormat("torch_modal.io.obj:obj_bytes"),
    ".off": OutputFormat("torch_modal.io.ply:off_bytes"),
    ".glb": OutputFormat("torch_modal.io.glb:glb_bytes", GLB_HOLDS),
    ".stl": OutputFormat("torch_modal.io.stl:stl_bytes"),
    ".vtk": OutputFormat("torch_modal.io.vtk:vtk_bytes", (), ("pyvista",), "vtk"),
    ".vtp": OutputFormat("torch_modal.io.vtk:vtp_bytes", (), ("pyvista",), "vtk"),
}
ANIMATION_FORMATS: dict[str, OutputFormat] = {
    ".glb": OutputFormat("torch_modal.io.glb:write_glb", GLB_HOLDS),
    ".mp4": OutputFormat("torch_modal.view.animation:write_mp4", FEATURES, ("imageio", "imageio_ffmpeg"), "video"),
    ".gif": OutputFormat("torch_modal.view.animation:write_gif", FEATURES),
    **dict.fromkeys(
        (".usd", ".usda", ".usdc"),
        OutputFormat("torch_modal.io.usd:write_usd", USD_HOLDS, ("pxr",), "usd"),
    ),
    ".abc": OutputFormat("torch_modal.io.alembic:write_alembic", ("polygons", "texcoords"), ("alembic3d",), "alembic"),
    **dict.fromkeys((".mdd", ".pc2"), OutputFormat("torch_modal.io.animations:write_point_cache", FEATURES)),
    ".npz": OutputFormat("torch_modal.io.animations:write_npz", FEATURES),
}
"""Videos and point caches have shapes alone, of which nobody needs a warning."""
PICTURES = (".png", ".pdf")
PAGES = (".html", ".htm")


def check_forms(path: Path, bones: object, targets: object) -> None:
    """Raise a ValueError for two forms of a GLB, or for a form of another format."""
    if (bones, targets) != (None, None) and (path.suffix.lower() != ".glb" or None not in (bones, targets)):
        raise ValueError(f"{path.name!r}: bones and targets are two forms of a .glb file; other formats hold neither")


class Timing:
    """Times and repetitions of a sequence that plays, after checks and with defaults.

    Arguments as for :func:`torch_modal.save_animation`.

    Raises:
        ValueError: A number is not positive, a cycle has ``ping_pong`` or ``ease``, or times do not fit.
    """

    def __init__(
        self,
        n_frames: int,
        n_keyframes: int = 2,
        *,
        duration: float | None = None,
        fps: float | None = None,
        cyclic: bool = False,
        ping_pong: bool = False,
        ease: bool = False,
        times: Sequence[float] | FloatArray | None = None,
    ) -> None:
        for name, value in (("duration", duration), ("fps", fps)):
            if value is not None and not 0 < value < np.inf:
                raise ValueError(f"{name} must be a positive number, got {value}")
        if cyclic and (ping_pong or ease):
            raise ValueError("ping_pong and ease are for sequences that begin and end; a cyclic one does neither")
        steps = max(n_frames if cyclic else n_frames - 1, 1)
        #: Time of each frame over the duration, from 0 on. *Shape:* ``(N,)``.
        self.parts = np.arange(n_frames) / steps
        if times is not None:
            when = check_times(times, n_frames, cyclic, "frame").numpy()
            if len(when) > 1:
                self.parts = ((when - when[0]) / (when[-1] - when[0]))[:n_frames]
        by_default = 1.0 if cyclic else max(2.0, n_keyframes - 1)  # a second for each interval of three and more
        #: Seconds of the sequence once, for a cycle with the step back to its start; pictures a second at a fixed rate.
        self.duration = float(duration or (steps / fps if fps else by_default))
        self.fps = float(fps or FPS)
        self.cyclic, self.ping_pong, self.ease = cyclic, ping_pong, ease

    def knots(self) -> tuple[FloatArray, IntArray]:
        """Times in seconds, and the index of the frame shown at each; players interpolate between them linearly."""
        parts, places = self.parts, np.arange(len(self.parts))
        if self.ease:
            parts = np.arccos(np.clip(1 - 2 * parts, -1, 1)) / np.pi
        times = self.duration * parts
        if self.cyclic:
            return np.append(times, self.duration), np.append(places, 0)
        if self.ping_pong:
            return np.concatenate([times, 2 * self.duration - times[-2::-1]]), np.concatenate([places, places[-2::-1]])
        return times, places

    def samples(self) -> FloatArray:
        """Fractional frame numbers at the fixed rate, without the repeated ends of loops.

        *Shape:* ``(T,)``, from 0 to ``N - 1`` (to ``N``, if cyclic, which is frame 0 again).
        """
        if len(self.parts) == 1:
            return np.zeros(1)
        steps = max(1, round(self.duration * self.fps))
        phase = np.arange(steps if self.cyclic else steps + 1) / steps
        if self.ease:
            phase = (1 - np.cos(np.pi * phase)) / 2
        if self.ping_pong:
            phase = np.concatenate([phase, phase[-2:0:-1]])
        known = np.append(self.parts, 1.0) if self.cyclic else self.parts
        return np.interp(phase, known, np.arange(len(known)))


def resample(frames: FloatArray, places: FloatArray) -> FloatArray:
    """Linear interpolation at fractional frame numbers. *Shape:* ``(N, V, 3), (T,) -> (T, V, 3)``."""
    left = np.floor(places).astype(np.int64)
    fraction = (places - left)[:, None, None]
    before, after = frames[left % len(frames)], frames[(left + 1) % len(frames)]
    return np.where(fraction > 0, (1 - fraction) * before + fraction * after, before)


class Animation(NamedTuple):
    """A sequence to write, as :func:`torch_modal.save_animation` passes it to a format, with arguments of these names.

    The timing has the times of frames in seconds, and samples at a fixed rate. *Shape:* ``(N, V, 3), (F, 3)``.
    """

    shapes: FloatArray
    faces: IntArray
    timing: Timing
    name: str
    """Name of the file, for messages."""
    keyframes: list[int]
    """Frame numbers of the key-frames."""
    asset: Asset | None
    progress: Progress
    skin: Skin | None = None
    """The motion as bones, instead of morph targets."""
    targets: int | None = None
    """Number of principal shapes, instead of a morph target for each frame."""
    size: int = PIXELS
    """The longer side of a picture of a video, in pixels."""
