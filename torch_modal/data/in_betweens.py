"""In-betweens of pairs of key-frames, which are kept in tables, and of shapes near them."""

import contextlib
import math
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

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


class PairTables:
    """In-betweens of the key-frames of a space, and of shapes near them.

    Between two key-frames they are solved once, at even times, and cubics interpolate among these; if the two follow
    each other in a motion, the shapes lie on its path. Other shapes are solved one by one, with the modes of the two
    nearest key-frames. K key-frames have K (K - 1) / 2 pairs: layers and tables are made when a pair is used, and the
    most recent stay in memory.

    Arguments are the checked ones of :class:`~torch_modal.data.space.ShapeSpace`; the folder need not be writable.

    Raises:
        ValueError: ``times`` is below 4.
    """

    def __init__(
        self,
        bases: list[ModalBasis],
        faces: Tensor,
        settings: Settings,
        motion: Tensor | None,
        times: int | None,
        dtype: torch.dtype,
        folder: str | os.PathLike[str] | None,
    ) -> None:
        if times is not None and times < 4:
            raise ValueError(f"times is {times}; cubics need 4 or more, and None solves each in-between")
        self.bases, self.faces, self.settings, self.motion = bases, faces, settings, motion
        self.times, self.dtype = times, dtype
        self.folder = None if folder is None else Path(folder)
        self.keyframes = torch.stack([basis.reference.double() for basis in bases])
        self._solvers, self._tables = Recent(32), Recent(64)

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
        keyframes = (i != j) & self._is_keyframe(x_a, i) & self._is_keyframe(x_b, j)
        # The same two key-frames in either order are solved together.
        swap = (i > j).to(t.device)
        t = torch.where(swap, 1 - t, t)
        starts, ends = (torch.where(swap[:, None, None], *pair) for pair in ((x_b, x_a), (x_a, x_b)))

        def solve(kind: list[int], rows: Tensor) -> Tensor:
            first, second, of_keyframes = kind
            rows = rows.to(t.device)
            if of_keyframes:
                return self.of_keyframes(first, second, t[rows])
            layer = self._layer(first, second, x_a)
            return _check_converged(layer.solve(starts[rows], ends[rows], t[rows]), first, second)

        return compute_by_kind(torch.stack([torch.minimum(i, j), torch.maximum(i, j), keyframes.long()], 1), solve)

    def of_keyframes(self, i: int, j: int, t: Tensor) -> Tensor:
        """Shapes between two key-frames, from their table if there are tables.

        *Shape:* ``(B,) -> (B, V, 3)``, in the dtype and on the device of ``t``. Raises and warns as a call.
        """
        if i > j:
            return self.of_keyframes(j, i, 1 - t)  # one table serves both ways
        if self.times is None:
            return _check_converged(self._solve(i, j, t), i, j)
        return interpolate(self.table(i, j), t.to("cpu", self.dtype)).to(t)

    def _is_keyframe(self, x: Tensor, i: Tensor) -> Tensor:
        """True for shapes without a gradient that are these key-frames, up to float32. *Shape:* ``(B,)``."""
        if x.requires_grad or is_transformed(x):
            return torch.zeros(len(x), dtype=torch.bool)
        return (x.float() == self.keyframes[i].to(x.device, torch.float32)).flatten(1).all(1).cpu()

    def table(self, i: int, j: int) -> Tensor:
        """In-betweens of two key-frames at even times, from disk if stored. *Shape:* ``(T, V, 3)``.

        Raises:
            ValueError: There are no in-betweens of the two.

        Warns:
            ConvergenceWarning: Some did not converge; the table is not stored, so that each run warns.
        """
        times, span = self.times, self._span(i, j)
        assert times is not None

        def compute() -> tuple[Tensor, bool]:
            with torch.no_grad():
                result = self._solve(i, j, torch.linspace(0, 1, times, dtype=torch.float64))
            return _check_converged(result, i, j).to(self.dtype), bool(result.solution.usable.all())

        bases = [self.bases[i], self.bases[j]] if span is None else self.bases
        tensors = [(basis.reference, basis.eigenvalues, basis.modes) for basis in bases]
        when = (times, span, None if span is None else self.motion)
        content = [tensors, self.faces, when, str(self.dtype), *self.settings]
        return self._tables.get((i, j), lambda: read_or_compute(self.folder, f"between-{i}-{j}", content, compute))

    def _layer(self, i: int, j: int, like: Tensor) -> InBetween:
        return self._solvers.get(
            (i, j, like.dtype, like.device),
            lambda: InBetween([self.bases[i], self.bases[j]], self.faces, **self.settings._asdict()).to(like),
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

    def _solve(self, i: int, j: int, t: Tensor) -> InBetweenResult:
        """Solve between two key-frames: along the motion if they follow each other in it, otherwise the pair alone."""
        span = self._span(i, j)
        places = [i, j] if span is None else list(range(len(self.bases)))
        shapes = self.keyframes[places].to(t)
        if span is None and not self.settings.objective.contact:
            return self._layer(i, j, t).solve(shapes[0], shapes[1], t)

        def make_path() -> MotionPath:
            # A path separates contacts the same way at all times, so that tables are smooth.
            bases, times = [self.bases[place] for place in places], None if span is None else self.motion
            cyclic = times is not None and len(times) > len(bases)
            return MotionPath(bases, self.faces, times, cyclic, **self.settings._asdict()).to(t)

        path = self._solvers.get((span is None and (i, j), t.dtype, t.device), make_path)
        if span is not None:
            start, end = torch.tensor(span, dtype=torch.float64, device=t.device)
            t = torch.lerp(start, end, t.double())  # exact at both ends
        return path.solve(shapes, t)


def compute_by_kind(kinds: Tensor, compute: Callable[[list[int], Tensor], Tensor]) -> Tensor:
    """Compute a batch by kinds: ``compute`` gets a kind and the indices of its rows; results are in the batch's order.

    Kinds are on the CPU. *Shape:* ``(B, n) -> (B, ...)``.
    """
    each, kind = kinds.unique(dim=0, return_inverse=True)
    rows = [torch.nonzero(kind == number).flatten() for number in range(len(each))]
    results = torch.cat([compute(each_kind, mine) for each_kind, mine in zip(each.tolist(), rows, strict=True)])
    return results[torch.argsort(torch.cat(rows)).to(results.device)]


def interpolate(table: Tensor, t: Tensor) -> Tensor:
    """Cubic Lagrange interpolation between shapes at even times in [0, 1], from the four nearest.

    Reads these four only, so that a memory-mapped table is not loaded whole. Exact at the times of the table.

    *Shape:* ``(T, V, 3), (B,) -> (B, V, 3)``, with T of 4 or more.
    """
    n = len(table)
    place = t * (n - 1)
    start = (place.detach().floor().long() - 1).clamp(0, n - 4)
    x = place - start
    # The basis polynomials of the nodes 0, 1, 2, 3.
    weights: list[Any] = [math.prod((x - j) / (i - j) for j in range(4) if j != i) for i in range(4)]
    return sum(weight[:, None, None] * table[start + i] for i, weight in enumerate(weights))  # type: ignore[return-value]


def read_or_compute(
    folder: Path | None, name: str, content: list[Any], compute: Callable[[], tuple[Tensor, bool]]
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
