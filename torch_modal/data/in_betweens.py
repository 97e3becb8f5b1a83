"""In-betweens of shapes near the key-frames of a space, and the tables of a stored set."""

import contextlib
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from torch_modal.autograd import Recent, is_transformed
from torch_modal.elastic.implicit import ConvergenceWarning
from torch_modal.inbetween.results import InBetweenResult
from torch_modal.inbetween.settings import Settings
from torch_modal.io.cache import CACHE_VERSION, ContentError, content_digest
from torch_modal.io.tensors import read_tensors, write_tensors
from torch_modal.layers.in_between import InBetween
from torch_modal.modes.basis import ModalBasis
from torch_modal.motion.path import Path as MotionPath
from torch_modal.version import __version__

FORMAT = "torch_modal.between"
VERSION = "1"


class InBetweens:
    """In-betweens of shapes near the key-frames of a space.

    Two key-frames that follow each other in a motion have shapes on its path between them; all others are solved with
    the modes of the two nearest key-frames. Layers are made when a pair is used, and the most recent stay in memory.
    Arguments are the checked ones of :class:`~torch_modal.data.space.ShapeSpace`.
    """

    def __init__(self, bases: list[ModalBasis], faces: Tensor, settings: Settings, motion: Tensor | None) -> None:
        self.bases, self.faces, self.settings, self.motion = bases, faces, settings, motion
        self.keyframes = torch.stack([basis.reference.double() for basis in bases])
        self._solvers = Recent(32)

    def __call__(self, x_a: Tensor, x_b: Tensor, t: Tensor, i: Tensor, j: Tensor) -> Tensor:
        """In-betweens of a batch of shapes ``x_a`` at 0 and ``x_b`` at 1, at the times ``t``. *Shape:* ``(B, V, 3)``.

        Args:
            x_a: *Shape:* ``(B, V, 3)``.
            x_b: Likewise.
            t: *Shape:* ``(B,)``.
            i: The key-frame whose modes serve at 0, on the CPU. *Shape:* ``(B,)``.
            j: Likewise at 1, perhaps the same.

        Raises:
            ValueError: A shape is not finite, has no size, or is the mirror image of the other.

        Warns:
            ConvergenceWarning: Some did not converge.
        """
        keyframes = self._is_keyframe(x_a, i) & self._is_keyframe(x_b, j)
        # The same two key-frames in either order are solved together.
        swap = (i > j).to(t.device)
        t = torch.where(swap, 1 - t, t)
        starts, ends = (torch.where(swap[:, None, None], *pair) for pair in ((x_b, x_a), (x_a, x_b)))

        def solve(kind: list[int], rows: Tensor) -> Tensor:
            first, second, of_keyframes = kind
            rows = rows.to(t.device)
            span = self._span(first, second) if of_keyframes else None
            if span is None:
                result = self._layer(first, second, x_a).solve(starts[rows], ends[rows], t[rows])
            else:
                start, end = torch.tensor(span, dtype=torch.float64, device=t.device)
                times = torch.lerp(start, end, t[rows].double())  # exact at both ends
                result = self._path(x_a).solve(self.keyframes.to(x_a), times)
            return _check_converged(result, first, second)

        return compute_by_kind(torch.stack([torch.minimum(i, j), torch.maximum(i, j), keyframes.long()], 1), solve)

    def _is_keyframe(self, x: Tensor, i: Tensor) -> Tensor:
        """True for shapes without a gradient that are these key-frames, up to float32. *Shape:* ``(B,)``."""
        if self.motion is None or x.requires_grad or is_transformed(x):
            return torch.zeros(len(x), dtype=torch.bool)
        return (x.float() == self.keyframes[i].to(x.device, torch.float32)).flatten(1).all(1).cpu()

    def _layer(self, i: int, j: int, like: Tensor) -> InBetween:
        return self._solvers.get(
            (i, j, like.dtype, like.device),
            lambda: InBetween([self.bases[i], self.bases[j]], self.faces, **self.settings._asdict()).to(like),
        )

    def _path(self, like: Tensor) -> MotionPath:
        cyclic = self.motion is not None and len(self.motion) > len(self.bases)
        return self._solvers.get(
            (like.dtype, like.device),
            lambda: MotionPath(self.bases, self.faces, self.motion, cyclic, **self.settings._asdict()).to(like),
        )

    def _span(self, i: int, j: int) -> tuple[float, float] | None:
        """Times of two key-frames, ``i < j``, that follow each other in a motion of three or more; otherwise None."""
        n = len(self.bases)
        if self.motion is None or n < 3:
            return None
        if j == i + 1:
            return float(self.motion[i]), float(self.motion[j])
        is_end_of_cycle = len(self.motion) > n and (i, j) == (0, n - 1)
        return (float(self.motion[n]), float(self.motion[j])) if is_end_of_cycle else None


def compute_by_kind(kinds: Tensor, compute: Callable[[list[int], Tensor], Tensor]) -> Tensor:
    """Compute a batch by kinds: ``compute`` gets a kind and the indices of its rows; results are in the batch's order.

    Kinds are on the CPU. *Shape:* ``(B, n) -> (B, ...)``.
    """
    each, kind = kinds.unique(dim=0, return_inverse=True)
    rows = [torch.nonzero(kind == number).flatten() for number in range(len(each))]
    results = torch.cat([compute(each_kind, mine) for each_kind, mine in zip(each.tolist(), rows, strict=True)])
    return results[torch.argsort(torch.cat(rows)).to(results.device)]


def read_or_compute(
    folder: Path | None, name: str, content: list[object], compute: Callable[[], tuple[Tensor, bool]]
) -> Tensor:
    """A table from its file in a folder; or a new one, which is written there if it is worth keeping.

    Content is everything that a table depends on but code and versions. Without a folder, or where an objective has
    terms of the user's own, whose code has no digest, tables are neither read nor written.
    """
    if folder is None:
        return compute()[0]
    try:
        key = {"content": content_digest([__version__, str(torch.__version__), CACHE_VERSION, *content])}
    except ContentError:
        return compute()[0]
    path = folder / f"{name}.safetensors"
    if (stored := read_tensors(path, FORMAT, VERSION, key)) is not None:
        return stored["shapes"]
    table, keep = compute()
    if keep:
        with contextlib.suppress(OSError):  # the folder may not be writable
            write_tensors(path, FORMAT, VERSION, {"shapes": table}, key)
    return table


def _check_converged(result: InBetweenResult, i: int, j: int) -> Tensor:
    """Raise for in-betweens that are not finite, and warn of unconverged ones; returns the in-betweens."""
    if not bool(result.shapes.isfinite().all()):
        raise ValueError(
            f"there is no in-between of some shapes near the key-frames {i} and {j}: one is not finite, has no size, "
            "or is the mirror image of the other"
        )
    usable = result.solution.usable
    if not bool(usable.all()):
        warnings.warn(
            f"{int((~usable).sum())} of {usable.numel()} in-betweens near the key-frames {i} and {j} did not converge "
            "and are only the best shapes found: give the space a solver of more max_steps or a larger tolerance, or "
            "key-frames that are nearer to each other",
            ConvergenceWarning,
            stacklevel=3,
        )
    return result.shapes
