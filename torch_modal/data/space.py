"""Key-frames of one connectivity: a space of shapes with a mean, components, new members and fits."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torch_modal.autograd import Recent, outside_inference_mode
from torch_modal.data.in_betweens import InBetweens, read_or_compute
from torch_modal.data.stored import StoredSet, motion_times
from torch_modal.data.strain import mode_scales
from torch_modal.geometry.canonical import size
from torch_modal.geometry.poisson import Reconstruction
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.vectors import norm, pick
from torch_modal.inbetween.settings import Objective, Preset, Solver, settings
from torch_modal.keyframes.check import check_keyframes
from torch_modal.layers.blend import Blend
from torch_modal.modes.basis import ModalBasis, as_bases
from torch_modal.statistics.components import Components
from torch_modal.statistics.fit import Fitted, fit
from torch_modal.statistics.variation import Variation
from torch_modal.times import Times

# Range of sizes for which squares of lengths and of areas are normal numbers in float32.
_FLOAT32_SIZES = 1e-3, 1e6


class ShapeSpace:
    """Key-frames of one connectivity; random shapes are drawn from it.

    Results that take long and that not every use needs (layers of a pair, scales of the modes of a key-frame, the
    variation of the key-frames) are computed once, when they are needed. Copies and pickles leave them out, so that
    worker processes can receive a space.

    Args:
        bases: The key-frames, *shape* ``(K, V, 3)``; or their bases (:func:`torch_modal.extract_bases`), which
            :class:`RandomModalDeformation` and ``preset="modal"`` need.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        preset: Preset of the in-betweens, as for :class:`torch_modal.InBetween`.
        objective: Their objective; replaces the preset's.
        solver: Their solver, whose backend also computes new members; replaces the preset's.
        dtype: Dtype of new members and of :meth:`keyframes`. Default: of the key-frames.
        folder: Folder that stores tables of members between runs; by default none is stored.
        keyframe_times: Times of the key-frames, if they are a motion, as for :class:`torch_modal.Path`. Partners of
            key-frames are then their neighbours in time, and in-betweens lie on that path.
        cyclic: Whether the last key-frame of the motion leads on to the first.
        contact: Whether contact keeps parts from passing through each other; replaces the objective's setting
            (docs/contact.md; extra ``contact``).

    Raises:
        ValueError: The bases do not fit each other or the faces, or ``keyframe_times`` do not ascend.
    """

    @outside_inference_mode
    def __init__(
        self,
        bases: ModalBasis | Sequence[ModalBasis] | Tensor,
        faces: Tensor,
        *,
        preset: Preset = "fast",
        objective: Objective | None = None,
        solver: Solver | None = None,
        dtype: torch.dtype | None = None,
        folder: str | os.PathLike[str] | None = None,
        keyframe_times: Times = None,
        cyclic: bool = False,
        contact: bool | None = None,
    ) -> None:
        self.bases = [basis.to("cpu") for basis in as_bases(bases)]
        # Checks and repairs the faces.
        self.faces = check_keyframes([self.bases[0].reference.double()], faces, warn=False).faces.cpu()
        self.settings = settings(preset, objective, solver, contact=contact)
        self.dtype = self.bases[0].reference.dtype if dtype is None else dtype
        #: Times of the key-frames, if they are a motion; if cyclic, with the time when the first comes again.
        self.motion, self.cyclic = motion_times(keyframe_times, len(self.bases), cyclic), cyclic
        self.folder = None if folder is None else Path(folder)
        self.in_betweens = InBetweens(self.bases, self.faces, self.settings, self.motion)
        self._keyframes = self.in_betweens.keyframes
        length = size(self._keyframes[0].numpy(), self.faces.numpy())
        #: The least precise dtype that can square areas of these shapes.
        self.least_dtype = torch.float32 if _FLOAT32_SIZES[0] <= length <= _FLOAT32_SIZES[1] else torch.float64
        #: Reconstructions by device, scales of modes by key-frame, and the variation.
        self._made = Recent(5 + len(self.bases))

    @classmethod
    def open(cls, stored: StoredSet, **options: Any) -> "ShapeSpace":
        """The space of a stored key-frame set, with its times if it is a motion; its folder stores the tables.

        Options as for the constructor.
        """
        options_of_set = {"folder": stored.folder, "keyframe_times": stored.times, "cyclic": stored.cyclic}
        return cls(stored.bases, stored.faces, **{**options_of_set, **options})

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

    def keyframes(self, like: Tensor | None = None) -> Tensor:
        """A copy of the key-frames, in the dtype and on the device of another tensor. *Shape:* ``(K, V, 3)``."""
        device, dtype = ("cpu", self.dtype) if like is None else (like.device, like.dtype)
        return self._keyframes.to(device, dtype, copy=True)

    @torch.no_grad()
    def nearest(self, x: Tensor) -> Tensor:
        """Index of the closest key-frame, up to a rigid motion. *Shape:* ``(B, V, 3) -> (B,)``."""
        x = x.detach()
        weights = self.reconstruction(x.device).areas.to(x)
        distances = [
            ((best_fit(key.expand_as(x), x, weights).apply(key) - x) ** 2).sum(-1) @ weights
            for key in self._keyframes.to(x)
        ]
        return torch.stack(distances).argmin(0).cpu()

    def strain(self, x: Tensor, rest: Tensor) -> Tensor:
        """Relative change of length of each edge. *Shape:* ``(B, V, 3), (B, V, 3) -> (B, E)``."""
        i, j = self.reconstruction(x.device).edges.unbind(1)
        rows = (y.movedim(-1, 0).contiguous() for y in (x, rest))
        after, before = (norm(pick(y, j) - pick(y, i)) for y in rows)
        return after / before - 1

    def reconstruction(self, device: torch.device | str = "cpu") -> Reconstruction:
        """The Poisson problem of the connectivity, with the weights of the first key-frame for all shapes."""
        device = torch.device(device)
        return self._made.get(device, lambda: Reconstruction(self._keyframes[0], self.faces).to(device))

    def mode_scales(self, index: int) -> Tensor:
        """Scales of the modes of a key-frame (:func:`~torch_modal.data.strain.mode_scales`). *Shape:* ``(k,)``.

        Raises:
            ValueError: The space was made of key-frames, without modes.
        """
        if not self.n_modes:
            raise ValueError("a space of key-frames has no modes: make it of bases, extract_bases(keyframes, faces)")
        return self._made.get(index, lambda: mode_scales(self.bases[index], self.faces))

    # ----------------------------------------------------------------------------------------------------- statistics
    @torch.no_grad()
    def mean(self, weights: Tensor | None = None) -> Tensor:
        """The shape of least weighted energy towards all key-frames (:class:`torch_modal.Blend`).

        Args:
            weights: Weights of the key-frames; equal by default. *Shape:* ``(K,)``.

        Returns:
            *Shape:* ``(V, 3)``, float64.
        """
        even = torch.full((len(self),), 1 / len(self), dtype=torch.float64)
        objective, solver = self.settings
        blend = Blend(self.bases, self.faces, objective=replace(objective, contact=False), solver=solver)
        return blend(self._keyframes, even if weights is None else weights.to(even))

    def components(self, n: int | None = None) -> Components:
        """Principal components of the key-frames, with coordinates of shapes and shapes of coordinates.

        Args:
            n: Number of components; by default all, one less than there are key-frames.

        Raises:
            ValueError: There are fewer components.
        """
        variation, most = self.variation(), len(self) - 1
        n = most if n is None else n
        if not 1 <= n <= most:
            raise ValueError(f"{len(self)} key-frames have {most} components; got n={n}")
        return Components(variation, n)

    def variation(self) -> Variation:
        """Variation of the key-frames, which :meth:`sample` and :meth:`fit` share.

        Raises:
            ValueError: There is only one key-frame.
        """
        if len(self) < 2:
            raise ValueError(
                "one key-frame alone does not vary; a space for sample, fit or components needs two or more"
            )
        return self._made.get("variation", lambda: Variation(self._keyframes, self.faces, self.settings.solver.backend))

    @torch.no_grad()
    def sample(
        self,
        n: int,
        generator: torch.Generator | None = None,
        *,
        concentration: float = 0.2,
        locality: float = 3.0,
        beyond: tuple[float, float] = (0.0, 0.0),
        on_keyframes: bool = True,
    ) -> Tensor:
        """New members: random mixtures of the key-frames, with weights that vary from part to part of the surface.

        Each part of the surface lies between the key-frames, a leg perhaps nearer to one and the head to another, so
        that lengths and angles stay as in the key-frames and their mixtures. A draw with folded triangles, more than
        the key-frames have, is made less local until it has none; if that fails, it is the key-frame of the largest
        weight. For shapes beyond the range of the key-frames, apply :class:`RandomModalDeformation`.

        Args:
            n: How many.
            generator: Source of random numbers; by default PyTorch's own.
            concentration: Of the Dirichlet density of the weights: 1 is even over all mixtures, less prefers single
                key-frames, more their mean.
            locality: Standard deviation of the logarithms of the weights over the surface; 0 means the same weights
                everywhere.
            beyond: Range of a factor, at most 1, drawn uniformly for each member: the weights are so much farther from
                even ones, and the shape from the mean, than a mixture. 0.2 continues a little beyond the key-frames.
            on_keyframes: Whether each member is laid on the mean of the key-frames by its weights, by least squares
                over the surface. Otherwise all are laid on the mean shape, whose pose is near the first key-frame's.

        Returns:
            *Shape:* ``(n, V, 3)``, in the dtype of the space.

        Raises:
            ValueError: An argument is out of range.
        """
        variation = self.variation()
        drawn = variation.draw(n, concentration, locality, beyond, generator)
        return (variation.members(*drawn, on_keyframes) + variation.origin).to(self.dtype)

    def members(self, n: int, concentration: float, locality: float, beyond: tuple[float, float]) -> Tensor:
        """Table of members that are drawn once, with a fixed seed, and stored with the other tables.

        Arguments and shape as for :meth:`sample`, in the dtype of the tables.
        """
        settings, folder = (n, concentration, locality, beyond), self.folder

        def draw() -> tuple[Tensor, bool]:
            generator = torch.Generator().manual_seed(0)
            return self.sample(n, generator, concentration=concentration, locality=locality, beyond=beyond), True

        content = [self._keyframes, self.faces, str(self.dtype), settings, "on key-frames"]
        return self._made.get(settings, lambda: read_or_compute(folder, "between-all", content, draw))

    def fit(
        self,
        points: Tensor,
        vertices: Tensor,
        *,
        near: int | Tensor | None = None,
        robust: bool = False,
        weights: Tensor | None = None,
        noise: float | None = None,
    ) -> Fitted:
        """Fit a shape to observed points: weights of the key-frames that vary over the surface, then elastic steps.

        Where points leave the shape open, lengths and angles of each part are as in the mixture of key-frames that
        looks most like it. Several sets of points are fitted independently.

        Gradients reach the points through weights and rigid motion, by the implicit function theorem; the elastic
        steps that follow, and the trust in points, are constants of the graph. There are no second derivatives.

        Args:
            points: In the caller's units, of at least three vertices; any rigid motion is followed. *Shape:*
                ``(..., n, 3)``.
            vertices: The vertex that each point shows. *Shape:* ``(n,)``.
            near: A key-frame, or weights of all, *shape* ``(K,)``, that the shape is likely near to. Default: all
                alike.
            robust: Whether points that fit nothing are ignored.
            weights: Of the points, constants, none below zero; a weight of two counts as much as two points. Zero,
                or False, is for points that were not seen, which may hold any number, NaN too. Each set needs three
                vertices of weights above zero. *Shape:* ``(n,)`` or ``(..., n)``, broadcast against the points.
            noise: Standard deviation of each coordinate of the points, in their units, if they are not exact. The
                noisier they are, the closer the shape stays to what is likely.

        Returns:
            The shapes with their weights, and their distance from each point. If a rigidly moved key-frame is nearer to
            the points, the result is that key-frame. Points of weight zero have a trust of zero; the shape's distance
            from them is a constant, and NaN where they are.

        Raises:
            ValueError: There is only one key-frame, an argument does not fit, or the points are in other units.
            RuntimeError: The points are within a transform of ``torch.func``, or have a tangent.
        """
        return fit(self.variation(), points, vertices, near, robust, weights, noise)
