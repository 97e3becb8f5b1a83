"""Key-frames of one connectivity with their modes, and what augmentations compute from them at first use."""

import math
import os
import warnings
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from torch_modal.autograd import Recent, lasting, transformed
from torch_modal.data.motion import Motion, Span
from torch_modal.data.reference import KeyframeReference, keyframe_reference
from torch_modal.data.stored import StoredSet
from torch_modal.data.table import interpolate, read_table, write_table
from torch_modal.geometry.canonical import size
from torch_modal.geometry.crossings import require_contact
from torch_modal.geometry.poisson import Reconstruction
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.vectors import norm, pick
from torch_modal.inbetween.results import InBetweenResult
from torch_modal.inbetween.settings import Objective, Preset, Solver, settings
from torch_modal.io.cache import CacheWarning, ContentError, code_digest, content_digest
from torch_modal.keyframes.check import check_keyframes
from torch_modal.layers.blend import Blend
from torch_modal.layers.in_between import InBetween
from torch_modal.motion.path import Path as MotionPath
from torch_modal.precompute.basis import ModalBasis
from torch_modal.solve.implicit import ConvergenceWarning
from torch_modal.solve.minimise import Status
from torch_modal.statistics.coordinates import Components
from torch_modal.statistics.fit import Fitted, Observations, checked_observations, checked_weights, fit
from torch_modal.statistics.variation import Variation
from torch_modal.version import __version__

# Sizes whose squares, and squares of areas, are usual numbers of float32.
_SIZES = 1e-3, 1e6

# Key-frames whose modes a mean has, at most.
_BASES_OF_MEAN = 6

Method = TypeVar("Method", bound=Callable[..., Any])


def kept(limit: int) -> Callable[[Method], Method]:
    """Decorate a method of a space whose most recent results are kept, for each dtype and device of a tensor.

    Args:
        limit: How many. Fewer than a batch needs would be computed again for each batch.
    """

    def decorate(method: Any) -> Any:
        @wraps(method)
        def run(self: "ShapeSpace", *args: Any, **named: Any) -> Any:
            given = [*enumerate(args), *sorted(named.items())]
            key = tuple((name, (x.dtype, x.device) if isinstance(x, Tensor) else x) for name, x in given)
            recent = self._made.setdefault(method.__name__, Recent(limit))
            return recent.get(key, lambda: method(self, *args, **named))

        return run

    return decorate


class ShapeSpace:
    """Key-frames of one connectivity with their modes; random shapes are drawn from it.

    Layers, factorisations and tables are computed at first use, in the process and on the device that use them; only
    the most recent stay in memory. Pickling leaves them out, so that worker processes can receive a space.

    Args:
        bases: The basis of each key-frame (:func:`torch_modal.extract_bases`).
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        preset: Of the in-betweens, as for :class:`torch_modal.InBetween`.
        objective: What they minimise; replaces the preset's.
        solver: How they are solved; replaces the preset's.
        times: Number of even times at which the in-betweens of two key-frames are solved once; cubics interpolate
            among them. None solves each in-between. At least 4.
        dtype: Of the tables.
        folder: Stores tables between runs; by default none is stored.
        keyframe_times: When the key-frames are, if they are a motion, as for :class:`torch_modal.Path`. Partners of
            key-frames are then those before and after them in time, and in-betweens are shapes of that path.
        cyclic: Whether the last key-frame of the motion leads on to the first.
        contact: Whether contact keeps parts from passing through each other; replaces the objective's setting
            (docs/contact.md; extra ``contact``).

    Raises:
        ValueError: The bases do not fit each other or the faces, ``times`` is below 4, or ``keyframe_times`` are not
            those of a motion.
    """

    @lasting
    def __init__(
        self,
        bases: ModalBasis | Sequence[ModalBasis],
        faces: Tensor,
        *,
        preset: Preset = "fast",
        objective: Objective | None = None,
        solver: Solver | None = None,
        times: int | None = 17,
        dtype: torch.dtype = torch.float32,
        folder: str | os.PathLike[str] | None = None,
        keyframe_times: Tensor | Sequence[float] | None = None,
        cyclic: bool = False,
        contact: bool | None = None,
    ) -> None:
        self.bases = [basis.to("cpu") for basis in ([bases] if isinstance(bases, ModalBasis) else bases)]
        if not self.bases:
            raise ValueError("a shape space needs one basis or more")
        sizes = {basis.n_vertices for basis in self.bases}
        if len(sizes) > 1:
            raise ValueError(f"the bases belong to meshes of {sorted(sizes)} vertices; a space has one connectivity")
        if times is not None and times < 4:
            raise ValueError(f"times is {times}; cubics need 4 or more, and None solves each in-between")
        # Checks and repairs the faces, as everywhere.
        self.faces = check_keyframes([self.bases[0].reference.double()], faces, warn=False).faces.cpu()
        self.settings = settings(preset, objective, solver, contact)
        if self.settings.objective.contact:
            require_contact()
        self.times = times
        self.dtype = dtype
        self.folder = None if folder is None else Path(folder)
        self.motion = Motion.of(keyframe_times, len(self.bases), cyclic)
        self._made: dict[str, Recent] = {}
        #: The space in the caller's units, if this is another (:meth:`in_units`).
        self._given: ShapeSpace | None = None

    @classmethod
    def open(cls, stored: StoredSet, **options: Any) -> "ShapeSpace":
        """The space of a stored key-frame set, with its times if it is a motion; its folder stores the tables.

        Options as for the constructor.
        """
        own = {"folder": stored.folder, "keyframe_times": stored.times, "cyclic": stored.cyclic}
        return cls(stored.bases, stored.faces, **{**own, **options})

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_made": {}}

    def __len__(self) -> int:
        """Number of key-frames, K."""
        return len(self.bases)

    @property
    def n_vertices(self) -> int:
        """Number of vertices, V."""
        return self.bases[0].n_vertices

    @property
    def n_modes(self) -> int:
        """Most modes that a key-frame has, k."""
        return max(basis.n_modes for basis in self.bases)

    @property
    def edges(self) -> Tensor:
        """Vertex indices of each edge. *Shape:* ``(E, 2)``."""
        return self.reconstruction().edges

    def keyframes(self, like: Tensor | None = None) -> Tensor:
        """A copy of the key-frames, in the dtype and on the device of another tensor. *Shape:* ``(K, V, 3)``."""
        return self._keyframes_like(torch.empty(0, dtype=self.dtype) if like is None else like).clone()

    @kept(4)
    def _keyframes_like(self, like: Tensor) -> Tensor:
        return torch.stack([basis.reference for basis in self.bases]).to(like)

    @property
    def unit(self) -> float:
        """A power of two near the size of the first key-frame, or 1 where its squares are usual numbers of float32."""
        length = self._size()
        return 1.0 if _SIZES[0] <= length <= _SIZES[1] else 2.0 ** round(math.log2(length))

    @kept(1)
    def _size(self) -> float:
        return size(self.bases[0].reference.double().numpy(), self.faces.numpy())

    @kept(1)
    def in_units(self) -> "ShapeSpace":
        """The same space with key-frames divided by :attr:`unit`, for computations in float32; tables are shared."""
        if self.unit == 1:
            return self
        found = copy(self)
        found._made, found._given = {}, self
        parts = ((b.reference / self.unit, b.eigenvalues, b.modes, b.rigid_eigenvalues) for b in self.bases)
        found.bases = [ModalBasis(*part) for part in parts]
        return found

    def nearest(self, x: Tensor) -> Tensor:
        """Index of the closest key-frame, up to a rigid motion. *Shape:* ``(B, V, 3) -> (B,)``."""
        if len(self) == 1:
            return torch.zeros(len(x), dtype=torch.int64)
        with torch.no_grad():
            x = x.detach()
            weights = self.reconstruction(x.device).areas.to(x)
            distances = [
                ((best_fit(key.expand_as(x), x, weights).apply(key) - x) ** 2).sum(-1) @ weights
                for key in self._keyframes_like(x)
            ]
        return torch.stack(distances).argmin(0).cpu()

    def strain(self, x: Tensor, rest: Tensor) -> Tensor:
        """Relative change of length of each edge. *Shape:* ``(B, V, 3), (B, V, 3) -> (B, E)``."""
        i, j = self.reconstruction(x.device).edges.unbind(1)
        rows = (y.movedim(-1, 0).contiguous() for y in (x, rest))
        after, before = (norm(pick(y, j) - pick(y, i)) for y in rows)
        return after / before - 1

    # ----------------------------------------------------------------------------------------------------- statistics
    @torch.no_grad()
    def mean(self, weights: Tensor | None = None) -> Tensor:
        """The shape of least weighted energy towards all key-frames (:class:`torch_modal.Blend`).

        Args:
            weights: Of the key-frames; even by default. *Shape:* ``(K,)``.

        Returns:
            *Shape:* ``(V, 3)``, float64.
        """
        even = torch.full((len(self),), 1 / len(self), dtype=torch.float64)
        return self._blend()(self._keyframes_like(even), even if weights is None else weights.to(even))

    @kept(1)
    def _blend(self) -> Blend:
        objective, solver = self.settings
        # Modes of a few tell those of all; further ones cost more than they give.
        few = self.bases[:: max(1, len(self) // _BASES_OF_MEAN)][:_BASES_OF_MEAN]
        return Blend(few, self.faces, objective=replace(objective, contact=False), solver=solver)

    def components(self, n: int | None = None) -> Components:
        """Principal components of the key-frames, with coordinates of shapes and shapes of coordinates.

        Args:
            n: How many; by default all, one less than there are key-frames.

        Raises:
            ValueError: There are fewer.
        """
        most = len(self) - 1
        if n is None:
            n = most
        if not 1 <= n <= most:
            raise ValueError(f"{len(self)} key-frames have {most} components; got n={n}")
        variation = self.variation()
        return Components(variation.coordinates, variation.average + variation.deviations, n, variation.origin)

    @kept(1)
    def variation(self) -> Variation:
        """How the key-frames vary, which :meth:`sample` and :meth:`fit` share.

        Raises:
            ValueError: There is only one key-frame.
        """
        if len(self) < 2:
            raise ValueError(
                "one key-frame alone does not vary; a space for sample, fit or components needs two or more"
            )
        shapes = self._keyframes_like(torch.empty(0, dtype=torch.float64))
        return Variation(shapes, self.faces)

    @torch.no_grad()
    def sample(
        self,
        n: int,
        generator: torch.Generator | None = None,
        *,
        concentration: float = 0.2,
        locality: float = 3.0,
    ) -> Tensor:
        """New members: random mixtures of the key-frames, with weights that vary from part to part of the surface.

        Each part of the surface lies between the key-frames, a leg perhaps nearer to one and the head to another, so
        that lengths and angles stay those of the key-frames and their mixtures. A draw in which triangles fold over
        that no key-frame has is made less local until none does; if that does not help, it is the key-frame of the
        largest weight. For shapes outside of what the key-frames show, apply :class:`RandomModalDeformation`.

        Args:
            n: How many.
            generator: Source of random numbers; by default PyTorch's own.
            concentration: Of the Dirichlet density of the weights: 1 is even over all mixtures, less prefers single
                key-frames, more their mean.
            locality: Standard deviation of the logarithms of the weights over the surface; with 0, all of it has the
                same.

        Returns:
            In the pose of the first key-frame. *Shape:* ``(n, V, 3)``, in the dtype of the space.

        Raises:
            ValueError: An argument is out of range.
        """
        if n < 0:
            raise ValueError(f"n is 0 or more, got {n}")
        check_density(concentration, locality)
        variation = self.variation()
        out = torch.empty(n, self.n_vertices, 3, dtype=self.dtype)
        for i in range(n):
            weights, factors = variation.draw(concentration, locality, generator)
            out[i] = variation.member(weights, factors)[0] + variation.origin
        return out

    def fit(
        self, points: Tensor, vertices: Tensor, *, near: int | Tensor | None = None, robust: bool = False
    ) -> Fitted:
        """The shape that meets observed points: weights of the key-frames that vary over the surface, then elasticity.

        What the points leave open is as in the key-frames: lengths and angles of each part are those of the mixture
        of key-frames that looks most like it. Of several sets of points, each is met on its own.

        Gradients reach the points. They are those of weights and rigid motion, by the implicit function theorem; the
        elastic steps that follow, and the trust in points, are constants of the graph. There are no second derivatives.

        Args:
            points: In the caller's units, of at least three vertices; any rigid motion is followed. *Shape:*
                ``(..., n, 3)``.
            vertices: The vertex that each point shows. *Shape:* ``(n,)``.
            near: A key-frame, or weights of all, *shape* ``(K,)``, that the shape is likely near to. Default: all
                alike.
            robust: Whether points that fit nothing are ignored.

        Returns:
            The shapes with their weights, and by how much they miss each point. Should the points be missed by more
            than of a key-frame that is moved rigidly, it is that one.

        Raises:
            ValueError: There is only one key-frame, points, vertices or weights do not fit, or the points are in other
                units.
            RuntimeError: The points are within a transform of ``torch.func``, or have a tangent.
        """
        if transformed(points):
            raise RuntimeError("fits have no forward mode, and no transforms of torch.func: take torch.autograd.grad")
        about = checked_weights(near, len(self))
        places = checked_observations(points, vertices, self.n_vertices)
        variation = self.variation()
        found = []
        for own in points.reshape(points.shape[:-2].numel(), *points.shape[-2:]):
            known = own.to("cpu", torch.float64)
            to = Observations(known, places, torch.ones_like(known[:, 0]))
            found.append(fit(variation, to, about, robust))
        lead, v, n = points.shape[:-2], self.n_vertices, len(places)
        if not found:
            sizes = (v, 3), (len(self), v), (n,), (n,)
            return Fitted(*(points.new_zeros(*lead, *shape) for shape in sizes))
        return Fitted(*(torch.stack(part).view(*lead, *part[0].shape).to(points) for part in zip(*found, strict=True)))

    # ------------------------------------------------------------------------------------------- computed at first use
    def reconstruction(self, device: torch.device | str = "cpu") -> Reconstruction:
        """The Poisson problem of the connectivity. The first key-frame's weights serve for all shapes."""
        return self._reconstruction(torch.device(device))

    @kept(4)
    def _reconstruction(self, device: torch.device) -> Reconstruction:
        return Reconstruction(self.bases[0].reference, self.faces).to(device)

    @kept(16)
    def reference(self, index: int, like: Tensor) -> KeyframeReference:
        """A key-frame for modal deformation, in the dtype and on the device of another tensor."""
        return keyframe_reference(self.bases[index], self.faces, self.edges, like)

    @kept(32)
    def layer(self, i: int, j: int, like: Tensor) -> InBetween:
        """The in-between layer of two key-frames' modes; ``i`` and ``j`` may be the same."""
        return self._layer(i, j, like)

    def _layer(self, i: int, j: int, like: Tensor) -> InBetween:
        objective, solver = self.settings
        return InBetween([self.bases[i], self.bases[j]], self.faces, objective=objective, solver=solver).to(like)

    def _span(self, i: int, j: int) -> Span | None:
        return None if self.motion is None else self.motion.span(i, j)

    def _between(self, i: int, j: int, like: Tensor) -> Callable[[Tensor], InBetweenResult]:
        """Between two key-frames themselves: along the motion if they follow each other in it, else of the pair."""
        span = self._span(i, j)
        objective, solver = self.settings
        if span is None and objective.contact:
            # A path separates contacts the same way at all times, so that tables are smooth.
            pair = MotionPath([self.bases[i], self.bases[j]], self.faces, objective=objective, solver=solver).to(like)
            return partial(pair.solve, self._keyframes_like(like)[[i, j]])
        if span is None:
            return partial(self._layer(i, j, like).solve, *self._keyframes_like(like)[[i, j]])
        bases = [self.bases[key] for key in span.keyframes]
        # The shapes depend on the neighbours only; a path of all key-frames would be computed for each table.
        path = MotionPath(bases, self.faces, span.times, objective=objective, solver=solver).to(like)
        return partial(path.solve, self._keyframes_like(like)[span.keyframes])

    @kept(64)
    def table(self, i: int, j: int) -> Tensor:
        """In-betweens of two key-frames at even times, from disk if stored. *Shape:* ``(T, V, 3)``."""
        if self.times is None:
            raise ValueError("a space of times=None solves each in-between: it has no tables")
        if self._given is not None:
            return self._given.table(i, j) / self._given.unit
        path, key = self._place(i, j)
        stored = None if path is None else read_table(path, key)
        if stored is not None:
            return stored
        t = torch.linspace(0, 1, self.times, dtype=torch.float64)
        with torch.no_grad():
            result = self._between(i, j, t)(t)
        table = _shapes(result, i, j).to(self.dtype)
        # Tables that did not converge are not stored, so that each run warns.
        if path is not None and bool(result.solution.usable.all()):
            write_table(path, table, key)
        return table

    def _place(self, i: int, j: int) -> tuple[Path | None, dict[str, str]]:
        """The file of a table and its key; None where it is not stored.

        Warns:
            CacheWarning: The objective has a term of the user's own, so that each process computes its tables again.
        """
        if self.folder is None:
            return None, {}
        try:
            content = self._content(i, j)
        except ContentError as error:
            warnings.warn(
                f"tables of in-betweens are not stored in {self.folder}, as their key cannot hold the objective's own "
                f"terms: {error}",
                CacheWarning,
                stacklevel=5,
            )
            return None, {}
        key = {"times": str(self.times), "dtype": str(self.dtype), "content": content}
        return self.folder / f"between-{i}-{j}.safetensors", key

    def _content(self, i: int, j: int) -> str:
        """A hash of all inputs of a table: bases, times, faces, settings and code."""
        span = self._span(i, j)
        bases = [self.bases[key] for key in (span.keyframes if span else (i, j))]
        tensors = [(basis.reference, basis.eigenvalues, basis.modes) for basis in bases]
        code = __version__, str(torch.__version__), code_digest()
        return content_digest([*code, tensors, self.faces, span and span.times, self.settings])

    # -------------------------------------------------------------------------------------------------- in-betweens
    def keyframe_in_between(self, i: int, j: int, t: Tensor) -> Tensor:
        """Between two key-frames themselves, from the table; along the motion if they follow each other in it.

        *Shape:* ``(B,) -> (B, V, 3)``, in the dtype of ``t``.
        """
        if i > j:
            return self.keyframe_in_between(j, i, 1 - t)  # one table serves both ways
        if self.times is None:
            return _shapes(self._kept_between(i, j, t)(t), i, j)
        table = self._table_on(i, j, t.device)
        return interpolate(table, t.to(table.dtype)).to(t.dtype)

    @kept(32)
    def _kept_between(self, i: int, j: int, like: Tensor) -> Callable[[Tensor], InBetweenResult]:
        return self._between(i, j, like)

    @kept(64)
    def _table_on(self, i: int, j: int, device: torch.device) -> Tensor:
        return self.table(i, j).to(device)

    def in_between(self, x_a: Tensor, x_b: Tensor, t: Tensor, i: int, j: int) -> Tensor:
        """Between any shapes, with the modes of two key-frames. *Shape:* ``(B, V, 3), (B, V, 3), (B,)``."""
        if i > j:
            return self.in_between(x_b, x_a, 1 - t, j, i)
        return _shapes(self.layer(i, j, x_a).solve(x_a, x_b, t), i, j)


def check_density(concentration: float, locality: float) -> None:
    """Check what new members are drawn with.

    Raises:
        ValueError: It is out of range.
    """
    if not 0 < concentration < torch.inf or not 0 <= locality < torch.inf:
        raise ValueError(f"concentration is above 0, locality 0 or more; got {concentration} and {locality}")


def _shapes(result: InBetweenResult, i: int, j: int) -> Tensor:
    """The in-betweens; raises for invalid shapes and warns of unconverged ones."""
    if not bool(result.shapes.isfinite().all()):
        raise ValueError(
            f"there is no in-between of some shapes near the key-frames {i} and {j}: one is not finite, has no size, "
            "or is the mirror image of the other"
        )
    status = result.solution.status
    missed = ~result.solution.usable
    if bool(missed.any()):
        names = ", ".join(sorted({Status(value).name for value in status[missed].tolist()}))
        warnings.warn(
            f"{int(missed.sum())} of {missed.numel()} in-betweens near the key-frames {i} and {j} did not converge "
            f"({names}) and are only the best shapes found: give the space a solver of more max_steps or a larger "
            "tolerance, or key-frames that are nearer to each other",
            ConvergenceWarning,
            stacklevel=2,
        )
    return result.shapes
