"""A motion as a few key-frames and a short vector for each frame: amplitudes of modes beside the smooth path."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path as FilePath
from typing import Any

import torch
from torch import Tensor

from torch_modal.codec.file import read, write_exact
from torch_modal.codec.fit import FittedFrames, fit
from torch_modal.codec.modes import ReproducibleModes, reproducible_modes
from torch_modal.codec.selection import FrameSequence, choose_keyframes, with_worst
from torch_modal.keyframes.check import check_keyframes
from torch_modal.motion.decoder import ModalDecoder
from torch_modal.progress import Progress, ProgressReport

ERROR = 0.002
"""Default for the largest mean distance of a frame's vertices, over the diagonal."""


@dataclass(frozen=True, eq=False)
class ModalSequence:
    """A motion: key-frames, and amplitudes, a rigid motion and a time for each frame.

    Modes follow from a key-frame, so they are not stored. Amplitudes are those of :class:`torch_modal.ModalDecoder`: 0
    is the smooth path, 1 moves vertices by 1 % of the diagonal. They mean the same in all frames.

    Attributes:
        keyframes: *Shape:* ``(K, V, 3)``.
        faces: *Shape:* ``(F, 3)``.
        keyframe_times: If cyclic, also when the first comes again. *Shape:* ``(K,)`` or ``(K + 1,)``.
        times: Of the frames. *Shape:* ``(T,)``.
        amplitudes: Zero at the key-frames. *Shape:* ``(T, k)``.
        motions: Rotations (axis times angle) about the centre, and translations in units of the diagonal. *Shape:*
            ``(T, 6)``.
        modes: Of the key-frame ``reference``.
        reference: Index of the key-frame that the modes belong to.
        errors: Mean distance of the vertices to the frame that was encoded, over the diagonal; NaN where that is not
            known. *Shape:* ``(T,)``.
    """

    keyframes: Tensor
    faces: Tensor
    keyframe_times: Tensor
    times: Tensor
    amplitudes: Tensor
    motions: Tensor
    modes: ReproducibleModes
    reference: int
    errors: Tensor

    @property
    def cyclic(self) -> bool:
        """Whether the last key-frame leads on to the first."""
        return len(self.keyframe_times) > len(self.keyframes)

    @property
    def n_frames(self) -> int:
        """T."""
        return len(self.times)

    @property
    def n_modes(self) -> int:
        """Amplitudes of a frame, k."""
        return self.amplitudes.shape[1]

    @property
    def n_floats(self) -> int:
        """Numbers to store: key-frames, and amplitudes, rigid motion and time of each other frame."""
        others = self.n_frames - int(self.is_keyframe.sum())
        return self.keyframes.numel() + len(self.keyframe_times) + others * (self.n_modes + 7)

    @property
    def is_keyframe(self) -> Tensor:
        """Which frames are key-frames. *Shape:* ``(T,)``."""
        return torch.isin(self.times, self.keyframe_times[: len(self.keyframes)])

    @cached_property
    def decoder(self) -> ModalDecoder:
        """Maps amplitudes and times to shapes, with gradients; made at the first use."""
        reference = self.keyframes[self.reference]
        return ModalDecoder(self.keyframes, self.faces, self.keyframe_times, reference, self.modes.modes)

    def decode(self, t: Any = None, progress: Progress = False) -> Tensor:
        """The frames, or the shapes at other times, by linear interpolation of the amplitudes.

        Args:
            t: Times, from the first to the last frame; if cyclic, any. Default: those of the frames. *Shape:*
                ``(N,)``, or a number.
            progress: See :data:`torch_modal.progress.Progress`.

        Returns:
            float64; key-frames bit for bit. *Shape:* ``(N, V, 3)``.

        Raises:
            ValueError: A time is outside that range.
        """
        with torch.no_grad():
            if t is None:
                times, a, motions = self.times, self.amplitudes, self.motions
            else:
                times = torch.as_tensor(t, dtype=torch.float64).reshape(-1)
                a, motions = self.at(times)
            out = torch.empty(len(times), *self.keyframes.shape[1:], dtype=torch.float64)
            with ProgressReport(len(times), "decoded frames", progress) as bar:
                for rows in torch.arange(len(times)).split(16):
                    out[rows] = self.decoder(a[rows], times[rows], motions[rows])
                    bar.update(len(rows))
            for shape, at in zip(self.keyframes, self.keyframe_times.tolist(), strict=False):
                out[times == at] = shape.double()
        return out

    def fit(self, frames: Any, times: Any) -> FittedFrames:
        """Fit amplitudes of other frames beside the same path, such as those of another motion of the same mesh.

        Args:
            frames: In the units of the key-frames. *Shape:* ``(N, V, 3)``.
            times: Place of each along the path. *Shape:* ``(N,)``.

        Returns:
            ``amplitudes (N, k)``, ``motions (N, 6)`` and ``errors (N,)``, to be passed to :attr:`decoder`.

        Raises:
            MeshError: Frames that cannot be used.
            ValueError: Times that do not fit the frames, or are outside the path.
        """
        x = check_keyframes(frames, self.faces, min_keyframes=1, warn=False)[0].detach().cpu().double()
        t = torch.as_tensor(times, dtype=torch.float64).reshape(-1)
        if x.shape[1:] != self.keyframes.shape[1:] or len(t) != len(x):
            raise ValueError(
                f"frames have the shape (N, {self.keyframes.shape[1]}, 3), and times (N,); got {tuple(x.shape)} and "
                f"{tuple(t.shape)}"
            )
        return fit(self.decoder, x, t, [])

    def at(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Amplitudes and rigid motions at any time. *Shape:* ``(N,) -> (N, k), (N, 6)``."""
        knots, values = self.times, torch.cat([self.amplitudes, self.motions], 1)
        if self.cyclic:
            period = self.keyframe_times[-1] - self.keyframe_times[0]
            t = self.keyframe_times[0] + (t - self.keyframe_times[0]) % period
            knots, values = torch.cat([knots, knots[:1] + period]), torch.cat([values, values[:1]])
        if bool(((t < knots[0]) | (t > knots[-1]) | t.isnan()).any()):
            raise ValueError(
                f"t lies between the times of the first and the last frame, {float(knots[0]):g} and "
                f"{float(knots[-1]):g}; got {float(t.min()):g} to {float(t.max()):g}"
            )
        right = torch.searchsorted(knots, t.contiguous()).clamp(1, len(knots) - 1)
        part = ((t - knots[right - 1]) / (knots[right] - knots[right - 1]))[:, None]
        mixed = torch.lerp(values[right - 1], values[right], part)
        return mixed[:, : self.n_modes], mixed[:, self.n_modes :]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a ``.tms`` file without loss, to be read by :meth:`load`; a failed write leaves no file.

        Raises:
            OSError: The file cannot be written.
        """
        write_exact(self.__dict__, FilePath(path))

    @classmethod
    def load(cls, path: str | os.PathLike[str], cache_dir: str | None = None, cache: bool = True) -> "ModalSequence":
        """Read a ``.tms`` file, and compute the modes again from its key-frame.

        Args:
            path: The file.
            cache_dir: Where modes are cached, as for :func:`torch_modal.extract_modes`.
            cache: Whether they are.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is damaged, holds something else, or has another version; or this machine finds other modes.
            MissingPackageError: :func:`torch_modal.compress` wrote it, and the extra ``compress`` is not installed.
        """
        return cls(**read(FilePath(path).read_bytes(), FilePath(path), cache_dir, cache))


def encode(
    frames: Any,
    faces: Any,
    keyframes: Sequence[int] | int | None = None,
    n_modes: int = 60,
    *,
    error: float = ERROR,
    times: Tensor | Sequence[float] | None = None,
    cyclic: bool = False,
    cache_dir: str | None = None,
    cache: bool = True,
    progress: Progress = None,
) -> ModalSequence:
    """Encode a motion as key-frames and amplitudes.

    Each frame is fitted by least squares of its vertices, after the best rigid motion, from the amplitudes of the frame
    before. Modes are those of the first key-frame, by the deterministic mesher.

    Args:
        frames: A motion of one connectivity, in any units. *Shape:* ``(T, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        keyframes: Which frames are key-frames, with the first, and, if not cyclic, the last; or how many; or, by
            default, as few as the ``error`` needs.
        n_modes: Amplitudes of a frame, k. A few more where eigenvalues are nearly the same.
        error: Largest mean distance of a frame's vertices, over the diagonal, where key-frames are selected.
        times: Of the frames, ascending; if cyclic, also when the first comes again. Default: 0, 1, 2, and so on.
            *Shape:* ``(T,)``, or ``(T + 1,)`` if cyclic.
        cyclic: Whether the last frame leads on to the first.
        cache_dir: Where modes are cached, as for :func:`torch_modal.extract_modes`.
        cache: Whether they are.
        progress: See :data:`torch_modal.progress.Progress`.

    Raises:
        MeshError: Frames that cannot be used.
        ValueError: Key-frames, times or numbers that cannot be used.
    """
    motion = FrameSequence.checked(frames, faces, times, cyclic)
    if isinstance(n_modes, bool) or not isinstance(n_modes, int) or n_modes < 1:
        raise ValueError(f"n_modes is {n_modes!r}; give a whole number of at least 1")
    if not 0 < error < 1:
        raise ValueError(f"error is a part of the diagonal, such as 0.002; got {error!r}")
    caching = {"cache_dir": cache_dir, "cache": cache}
    keys = choose_keyframes(motion, keyframes, n_modes, error, caching, progress)
    modes = reproducible_modes(motion.frames[0], motion.faces, n_modes, **caching)  # type: ignore[arg-type]
    while True:
        found = fitted(motion, keys, motion.frames[keys], modes, progress)
        if keyframes is not None or float(found.errors.max()) <= error:
            return found
        keys = with_worst(keys, found.errors, error)


def fitted(
    motion: FrameSequence,
    keys: Sequence[int],
    keyframes: Tensor,
    modes: ReproducibleModes,
    progress: Progress = None,
    only: Sequence[int] | None = None,
) -> ModalSequence:
    """The sequence of given key-frames, rounded or not, fitted to all frames or ``only`` some."""
    key_times = motion.times[motion.ends(keys)]
    decoder = ModalDecoder(keyframes, motion.faces, key_times, keyframes[0], modes.modes)
    times = motion.times[: len(motion.frames)]
    with ProgressReport(len(times if only is None else only), "encoded frames", progress) as bar:
        found = fit(decoder, motion.frames, times, keys, bar.update, only)
    return ModalSequence(
        keyframes, motion.faces, key_times, times, found.amplitudes, found.motions, modes, 0, found.errors
    )
