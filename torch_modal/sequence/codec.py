"""A motion as a few key-frames and a short vector for each frame: amplitudes of modes beside the smooth path."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path as FilePath
from typing import Any

import torch
from torch import Tensor

from torch_modal.keyframes.check import check_keyframes
from torch_modal.keyframes.times import checked_times
from torch_modal.nn.modal_decoder import ModalDecoder
from torch_modal.progress import Progress, ProgressReport
from torch_modal.sequence.codec_file import read, write_exact
from torch_modal.sequence.codec_fit import Fit, fit
from torch_modal.sequence.codec_modes import FixedModes, fixed_modes
from torch_modal.sequence.codec_selection import select_keyframes

ERROR = 0.002
"""Mean distance over the diagonal that key-frames are chosen for, if nothing is said."""


@dataclass(frozen=True, eq=False)
class ModalSequence:
    """A motion: key-frames, and amplitudes, a rigid motion and a time for each frame.

    Modes are a function of a key-frame and cost nothing. Amplitudes are those of :class:`torch_modal.ModalDecoder`: 0
    is the smooth path, 1 moves vertices by 1 % of the diagonal. They mean the same in all frames.

    Attributes:
        keyframes: *Shape:* ``(K, V, 3)``.
        faces: *Shape:* ``(F, 3)``.
        keyframe_times: If cyclic, with the time when the first comes again. *Shape:* ``(K,)`` or ``(K + 1,)``.
        times: When the frames are. *Shape:* ``(T,)``.
        amplitudes: Zero at the key-frames. *Shape:* ``(T, k)``.
        motions: Turns (axis times angle) about the centre, and moves in units of the diagonal. *Shape:* ``(T, 6)``.
        modes: Of the key-frame ``reference``.
        reference: Which key-frame the modes belong to.
        errors: Mean distance of the vertices to the frame that was encoded, over the diagonal; NaN where that is not
            known. *Shape:* ``(T,)``.
    """

    keyframes: Tensor
    faces: Tensor
    keyframe_times: Tensor
    times: Tensor
    amplitudes: Tensor
    motions: Tensor
    modes: FixedModes
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
        """Numbers that the motion needs: key-frames, and amplitudes, rigid motion and time of each other frame."""
        others = self.n_frames - int(self.is_keyframe.sum())
        return self.keyframes.numel() + len(self.keyframe_times) + others * (self.n_modes + 7)

    @property
    def is_keyframe(self) -> Tensor:
        """Which frames are key-frames. *Shape:* ``(T,)``."""
        return torch.isin(self.times, self.keyframe_times[: len(self.keyframes)])

    @cached_property
    def decoder(self) -> ModalDecoder:
        """Amplitudes and times to shapes, differentiable: made at the first use."""
        reference = self.keyframes[self.reference]
        return ModalDecoder(self.keyframes, self.faces, self.keyframe_times, reference, self.modes.modes)

    def decode(self, t: Any = None, progress: Progress = False) -> Tensor:
        """The frames, or the shapes at other times, whose amplitudes lie on straight lines between those of frames.

        Args:
            t: Times, from the first to the last frame; if cyclic, any. Default: those of the frames. *Shape:*
                ``(N,)``, or a number.
            progress: See :data:`torch_modal.progress.Progress`.

        Returns:
            float64; key-frames bit for bit. *Shape:* ``(N, V, 3)``.

        Raises:
            ValueError: A time outside.
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

    def fit(self, frames: Any, times: Any) -> Fit:
        """Amplitudes of other frames beside the same path, such as those of another motion of the same mesh.

        Args:
            frames: In units of their own key-frames. *Shape:* ``(N, V, 3)``.
            times: Where along the path each is. *Shape:* ``(N,)``.

        Returns:
            ``amplitudes (N, k)``, ``motions (N, 6)`` and ``errors (N,)``, to be passed to :attr:`decoder`.

        Raises:
            MeshError: Frames that cannot be used.
            ValueError: Times that do not fit the frames, or are outside.
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
        """Write a ``.tms`` file without loss, to be read by :meth:`load`; it is whole or absent.

        Raises:
            OSError: The file cannot be written.
        """
        write_exact(self.__dict__, FilePath(path))

    @classmethod
    def load(cls, path: str | os.PathLike[str], cache_dir: str | None = None, cache: bool = True) -> "ModalSequence":
        """Read a ``.tms`` file, and compute the modes again from its key-frame.

        Args:
            path: The file.
            cache_dir: Where modes are kept, as for :func:`torch_modal.extract_modes`.
            cache: Whether they are.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is damaged, holds something else, or has another version; or this machine finds other modes.
            MissingPackageError: :func:`torch_modal.compress` wrote it, and the extra ``compress`` is not there.
        """
        return cls(**read(FilePath(path), cache_dir, cache))


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
    """A motion as key-frames and amplitudes.

    Each frame is fitted by least squares of its vertices, after the best rigid motion, from the amplitudes of the frame
    before. Modes are those of the first key-frame, by the deterministic mesher.

    Args:
        frames: A motion of one connectivity, in any units. *Shape:* ``(T, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        keyframes: Which frames are key-frames, with the first, and, if not cyclic, the last; or how many; or, by
            default, as few as the ``error`` asks for.
        n_modes: Amplitudes of a frame, k. A few more where eigenvalues are nearly the same.
        error: Mean distance of the vertices over the diagonal that no frame is above, where key-frames are not given.
        times: When the frames are, ascending; if cyclic, and when the first comes again. Default: 0, 1, 2, and so on.
            *Shape:* ``(T,)``, or ``(T + 1,)`` if cyclic.
        cyclic: Whether the last frame leads on to the first.
        cache_dir: Where modes are kept, as for :func:`torch_modal.extract_modes`.
        cache: Whether they are.
        progress: See :data:`torch_modal.progress.Progress`.

    Raises:
        MeshError: Frames that cannot be used.
        ValueError: Key-frames, times or numbers that cannot be used.
    """
    shapes, working_faces = check_keyframes(frames, faces, min_keyframes=2, warn=False)
    if isinstance(n_modes, bool) or not isinstance(n_modes, int) or n_modes < 1:
        raise ValueError(f"n_modes is {n_modes!r}; give a whole number of at least 1")
    x, triangles = shapes.detach().cpu().double(), working_faces.cpu()
    if not 0 < error < 1:
        raise ValueError(f"error is a part of the diagonal, such as 0.002; got {error!r}")
    when = checked_times(times, len(x), cyclic)
    kept = {"cache_dir": cache_dir, "cache": cache}
    keys = chosen_keys(x, triangles, when, keyframes, n_modes, error, cyclic, kept, progress)
    modes = fixed_modes(x[keys[0]], triangles, n_modes, **kept)  # type: ignore[arg-type]
    while True:
        found = fitted(x, triangles, when, x[keys], keys, cyclic, modes, progress)
        if keyframes is not None or float(found.errors.max()) <= error:
            return found
        keys = with_worst(keys, found.errors, error)


def chosen_keys(
    frames: Tensor,
    faces: Tensor,
    when: Tensor,
    keyframes: Sequence[int] | int | None,
    n_modes: int,
    error: float,
    cyclic: bool,
    kept: dict[str, Any],
    progress: Progress = None,
) -> list[int]:
    """The key-frames that a caller names, or those that are found. Arguments as for :func:`encode`."""
    if not isinstance(keyframes, (int, type(None))):
        return _checked_keys(keyframes, len(frames), cyclic)
    modes = fixed_modes(frames[0], faces, n_modes, **kept)
    return select_keyframes(frames, faces, when, modes.modes, keyframes, error, cyclic, progress)


def with_worst(keys: Sequence[int], errors: Tensor, error: float) -> list[int]:
    """Key-frames, and the worst frame of each interval that has one above an error."""
    ends = [*keys, len(errors)]
    worst = [a + int(errors[a:b].argmax()) for a, b in pairwise(ends)]
    return sorted({*keys, *(f for f in worst if float(errors[f]) > error)})


def fitted(
    frames: Tensor,
    faces: Tensor,
    when: Tensor,
    keyframes: Tensor,
    keys: Sequence[int],
    cyclic: bool,
    modes: FixedModes,
    progress: Progress = None,
    only: Sequence[int] | None = None,
) -> ModalSequence:
    """The sequence of given key-frames, rounded or not, with modes of the first; of all frames, or ``only`` some."""
    key_times = when[[*keys, len(frames)]] if cyclic else when[list(keys)]
    decoder = ModalDecoder(keyframes, faces, key_times, keyframes[0], modes.modes)
    times = when[: len(frames)]
    with ProgressReport(len(frames if only is None else only), "encoded frames", progress) as bar:
        found = fit(decoder, frames, times, keys, bar.update, only)
    return ModalSequence(keyframes, faces, key_times, times, found.amplitudes, found.motions, modes, 0, found.errors)


def _checked_keys(keyframes: Any, n_frames: int, cyclic: bool) -> list[int]:
    keys = [int(i) for i in keyframes]
    wanted = "the first frame" if cyclic else "the first and the last frame"
    ends = {0} if cyclic else {0, n_frames - 1}
    ascending = all(a < b for a, b in pairwise(keys))
    if len(keys) < 2 or not ascending or not ends <= set(keys) or keys[-1] >= n_frames or keys[0] < 0:
        raise ValueError(
            f"keyframes are two or more ascending frame numbers from 0 to {n_frames - 1}, with {wanted} among them; "
            f"got {keys}"
        )
    return keys
