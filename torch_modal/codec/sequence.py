"""A motion as a few key-frames and a short vector for each frame: amplitudes of modes added to the smooth path."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from torch_modal.arrays import ArrayLike
from torch_modal.codec.fit import FittedFrames, fit
from torch_modal.codec.packing import BY_16_BITS, LEAST, SHARE, pack, reduce_modes, unpack
from torch_modal.codec.selection import LARGEST_ERROR, check_motion, insert_keyframes
from torch_modal.io.tensors import TensorFile, write_tensors
from torch_modal.keyframes.arrays import check_tensor
from torch_modal.keyframes.check import check_keyframes
from torch_modal.modes.extract import extract_modes
from torch_modal.motion.decoder import ModalDecoder
from torch_modal.progress import Progress, ProgressReport
from torch_modal.times import Times, locate_times

FORMAT = "torch_modal.sequence"
VERSION = "4"
STORED = ("faces", "keyframe_times", "times", "amplitudes", "motions", "errors", "keyframes", "modes")


@dataclass(frozen=True, eq=False)
class ModalSequence:
    """A motion: key-frames, and amplitudes, a rigid motion and a time for each frame.

    Amplitudes are as in :class:`torch_modal.ModalDecoder`: 0 is the smooth path, 1 moves vertices by 1 % of the
    diagonal. They mean the same in all frames.

    Attributes:
        keyframes: *Shape:* ``(K, V, 3)``.
        faces: *Shape:* ``(F, 3)``.
        keyframe_times: If cyclic, also when the first comes again. *Shape:* ``(K,)`` or ``(K + 1,)``.
        times: Of the frames. *Shape:* ``(T,)``.
        amplitudes: Zero at the key-frames. *Shape:* ``(T, k)``.
        motions: Rotations (axis times angle) about the centre, and translations in units of the diagonal. *Shape:*
            ``(T, 6)``.
        modes: Of the first key-frame, or combinations of them. *Shape:* ``(k, V, 3)``.
        errors: Mean distance of the vertices to the frame that was encoded, over the diagonal. *Shape:* ``(T,)``.
        decoder: Maps amplitudes and times to shapes, with gradients.

    Raises:
        ValueError: Key-frames, their times or modes do not fit each other.
    """

    keyframes: Tensor
    faces: Tensor
    keyframe_times: Tensor
    times: Tensor
    amplitudes: Tensor
    motions: Tensor
    modes: Tensor
    errors: Tensor
    decoder: ModalDecoder = field(init=False, repr=False)

    def __post_init__(self) -> None:
        decoder = ModalDecoder(self.keyframes, self.faces, self.keyframe_times, self.keyframes[0], self.modes)
        object.__setattr__(self, "decoder", decoder)

    def __repr__(self) -> str:
        n, shape = len(self.times), tuple(self.keyframes.shape)
        return f"<ModalSequence of {n} frames: key-frames {shape}, {self.n_modes} modes>"

    @property
    def cyclic(self) -> bool:
        """True if the last key-frame leads on to the first."""
        return len(self.keyframe_times) > len(self.keyframes)

    @property
    def n_modes(self) -> int:
        """Number of amplitudes of a frame, k."""
        return self.amplitudes.shape[1]

    @property
    def n_floats(self) -> int:
        """Number of floats of the motion: key-frames, and amplitudes, rigid motion and time of each other frame.

        Without modes, which :func:`torch_modal.extract_modes` computes again from the first key-frame.
        """
        others = len(self.times) - int(self.is_keyframe.sum())
        return self.keyframes.numel() + len(self.keyframe_times) + others * (self.n_modes + 7)

    @property
    def is_keyframe(self) -> Tensor:
        """True for the frames that are key-frames. *Shape:* ``(T,)``."""
        return torch.isin(self.times, self.keyframe_times[: len(self.keyframes)])

    def decode(self, t: "ArrayLike | None" = None) -> Tensor:
        """The frames, or the shapes at other times, by linear interpolation of the amplitudes.

        Args:
            t: Times, from the first to the last frame; if cyclic, any. Default: the times of the frames. *Shape:*
                ``(N,)``, or a number.

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
                a, motions = self._at(times)
            out = self.decoder(a, times, motions)
            for shape, time in zip(self.keyframes, self.keyframe_times.tolist(), strict=False):
                out[times == time] = shape
        return out

    def fit(self, frames: ArrayLike, times: ArrayLike) -> FittedFrames:
        """Fit amplitudes of other frames along the same path, such as frames of another motion of the same mesh.

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
        check_tensor("frames", x, len(t), *self.keyframes.shape[1:], hint="one time for each frame")
        return fit(self.decoder, x, t)

    def _at(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Amplitudes and rigid motions at any time. *Shape:* ``(N,) -> (N, k), (N, 6)``."""
        times, values = self.times, torch.cat([self.amplitudes, self.motions], 1)
        if self.cyclic:
            period = self.keyframe_times[-1] - self.keyframe_times[0]
            times, values = torch.cat([times, times[:1] + period]), torch.cat([values, values[:1]])
        before, u = locate_times(t, times, self.cyclic, of="frame")
        mixed = torch.lerp(values[before], values[before + 1], u[:, None])
        return mixed[:, : self.n_modes], mixed[:, self.n_modes :]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a safetensors file, which replaces another; a failed write leaves no file.

        Shapes have 16 bits, or 32 where the errors are below 4e-4, and modes are combined to as few as the errors
        allow. Frames move by a twentieth of the largest error at most, which the errors of the file include.

        Raises:
            OSError: The file cannot be written.
        """
        allowed = max(SHARE * float(self.errors.max()), LEAST)
        size = float(self.decoder.size)
        modes, amplitudes = reduce_modes(self.modes, self.amplitudes, size, allowed)
        faces = self.faces.to(torch.int16 if self.keyframes.shape[1] < 2**15 else torch.int32)
        packed = {
            **pack("keyframes", self.keyframes, exact=allowed < BY_16_BITS),
            **pack("modes", modes),
            **{"faces": faces, "amplitudes": amplitudes.float(), "motions": self.motions.float()},
            **{"keyframe_times": self.keyframe_times, "times": self.times, "errors": self.errors},
        }
        moved = self._unpacked(packed).decode() - self.decode()
        packed["errors"] = self.errors + moved.norm(dim=-1).mean(1) / size
        write_tensors(Path(path), FORMAT, VERSION, packed)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "ModalSequence":
        """Read a file that :meth:`save` wrote.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is damaged, holds something else, or has another version.
        """
        return cls._unpacked(TensorFile(Path(path), FORMAT, VERSION, STORED).tensors())

    @classmethod
    def _unpacked(cls, tensors: dict[str, Tensor]) -> "ModalSequence":
        shapes = {name: unpack(name, tensors) for name in ("keyframes", "modes")}
        wide = {name: tensors[name].double() for name in ("amplitudes", "motions", "keyframe_times", "times", "errors")}
        return cls(**shapes, **wide, faces=tensors["faces"].long())


def encode(
    frames: ArrayLike,
    faces: ArrayLike,
    keyframes: Sequence[int] | int | None = None,
    n_modes: int = 60,
    *,
    error: float = LARGEST_ERROR,
    times: Times = None,
    cyclic: bool = False,
    cache_dir: str | None = None,
    cache: bool = True,
    progress: Progress = None,
) -> ModalSequence:
    """Encode a motion as key-frames and amplitudes.

    Each frame is fitted by least squares of its vertices, after the best rigid motion, starting from the amplitudes of
    the frame before. Modes are the vibration modes of the first frame.

    Args:
        frames: A motion of one connectivity, in any units. *Shape:* ``(T, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        keyframes: Numbers of the frames that are key-frames, with the first, and, if not cyclic, the last; or their
            number, or None for as few as the ``error`` needs.
        n_modes: Amplitudes of a frame, k.
        error: Largest mean distance of a frame's vertices, over the diagonal, where ``keyframes`` is None.
        times: Of the frames, ascending; if cyclic, also when the first comes again. Default: 0, 1, 2, and so on.
            *Shape:* ``(T,)``, or ``(T + 1,)`` if cyclic.
        cyclic: Whether the last frame leads on to the first.
        cache_dir: Folder where modes are cached, as for :func:`torch_modal.extract_modes`.
        cache: Whether they are.
        progress: See :data:`torch_modal.progress.Progress`.

    Raises:
        MeshError: Frames that cannot be used.
        ValueError: Key-frames, times or numbers that cannot be used.
    """
    x, triangles, when = check_motion(frames, faces, times, cyclic)
    if not 0 < error < 1:
        raise ValueError(f"error must be a positive fraction of the diagonal, such as 0.002; got {error!r}")
    n = len(x)
    modes = extract_modes(x[0], triangles, n_modes, cache_dir=cache_dir, cache=cache).modes
    if keyframes is None or isinstance(keyframes, int):
        keys = insert_keyframes(x, triangles, when, cyclic, modes, keyframes, error, progress)
    else:
        keys, required = [int(i) for i in keyframes], {0} if cyclic else {0, n - 1}
        if len(keys) < 2 or keys != sorted({*keys}) or not required <= {*keys} <= {*range(n)}:
            raise ValueError(f"keyframes must be two or more ascending frame numbers, with {required}; got {keys}")
    while True:
        key_times = when[[*keys, n]] if cyclic else when[keys]
        amplitudes, motions, errors = (torch.zeros(n, *size).double() for size in ((len(modes),), (6,), ()))
        sequence = ModalSequence(x[keys], triangles, key_times, when[:n], amplitudes, motions, modes, errors)
        others = torch.nonzero(~sequence.is_keyframe)[:, 0]
        with ProgressReport(len(others), "encoded frames", progress) as bar:
            fitted = fit(sequence.decoder, x[others], when[others], bar.update)
        amplitudes[others], motions[others], errors[others] = fitted
        if keyframes is not None or float(errors.max()) <= error:
            return sequence
        # Errors were estimated from samples: add the worst frame of each interval that has one above the error.
        worst = [a + int(errors[a:b].argmax()) for a, b in pairwise([*keys, n])]
        keys = sorted({*keys, *(f for f in worst if float(errors[f]) > error)})
