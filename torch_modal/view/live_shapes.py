"""Key-frames that handles and modes deform, and their in-betweens: the model of a live session."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torch_modal.inbetween.settings import PRESETS, Preset
from torch_modal.layers.in_between import InBetween
from torch_modal.precompute.basis import ModalBasis

# Part of the mean compliance by which handles may be missed, so that close handles do not conflict.
HANDLE_SLACK = 1e-6


class LiveShapes:
    """In-betweens of key-frames that handles and single modes deform.

    A key-frame with handles is the shape of least linear elastic energy that meets them, in the space of its modes:

        minimise  1/2 sum_i lambda_i a_i^2    such that  Phi_h a = d                                       (1)

    with the handles' moves d, so a = L^-1 Phi_h^T (Phi_h L^-1 Phi_h^T)^-1 d with the diagonal L of the eigenvalues.
    Single modes are added to it. Far moves distort, as linear modes do.

    Args:
        keyframes: *Shape:* ``(K, V, 3)``, K of 2 or more.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        bases: A basis of each key-frame.
    """

    def __init__(self, keyframes: Tensor, faces: Tensor, bases: Sequence[ModalBasis]) -> None:
        if len(keyframes) < 2 or len(bases) != len(keyframes):
            raise ValueError(
                f"a live session needs two key-frames or more and a basis of each, got {len(keyframes)} key-frames and "
                f"{len(bases)} bases"
            )
        self.given = keyframes.double()
        self.faces = faces
        self.modes = [basis.modes.double() for basis in bases]
        self.eigenvalues = [basis.eigenvalues.double() for basis in bases]
        self.handles: list[dict[int, Tensor]] = [{} for _ in bases]
        self.amounts: list[dict[int, float]] = [{} for _ in bases]
        self.keyframes = self.given.clone()
        self._layers = {preset: self._layer(bases, preset) for preset in ("fast", "accurate")}

    def _layer(self, bases: Sequence[ModalBasis], preset: Preset) -> InBetween:
        """A layer whose stiffnesses are tensors, so that they can be changed in place."""
        objective, solver = PRESETS[preset]
        alpha, beta, gamma = (
            torch.as_tensor(value, dtype=torch.float64).clone()
            for value in (objective.alpha, objective.beta, objective.gamma)
        )
        own = replace(objective, alpha=alpha, beta=beta, gamma=gamma)
        return InBetween(bases, self.faces, objective=own, solver=solver)

    @property
    def n_modes(self) -> int:
        """How many modes every key-frame has."""
        return min(len(modes) for modes in self.modes)

    def set_stiffness(self, stretch: float, bend: float, volume: float) -> None:
        """Multiples of the three stiffnesses of Eq. 5."""
        for preset, layer in self._layers.items():
            objective = PRESETS[preset].objective
            values = (objective.alpha * stretch, objective.beta * bend, objective.gamma * volume)
            for term, value in zip(layer.terms, values, strict=True):
                term.stiffness.fill_(value)

    def set_mode(self, keyframe: int, mode: int, amount: float) -> None:
        """Add so much of a mode to a key-frame; 1 moves the farthest vertex by a tenth of the diagonal."""
        self.amounts[keyframe][mode] = amount
        self._deform(keyframe)

    def set_handles(self, keyframe: int, handles: Mapping[int, Tensor]) -> None:
        """Deform a key-frame so that these vertices come to these places. *Shape of each:* ``(3,)``."""
        self.handles[keyframe] = {vertex: place.double() for vertex, place in handles.items()}
        self._deform(keyframe)

    def reset(self) -> None:
        """Restore the given key-frames."""
        self.handles, self.amounts = [{} for _ in self.handles], [{} for _ in self.amounts]
        self.keyframes = self.given.clone()

    def _deform(self, keyframe: int) -> None:
        modes, shape = self.modes[keyframe], self.given[keyframe].clone()
        diagonal = (shape.amax(0) - shape.amin(0)).norm()
        for mode, amount in self.amounts[keyframe].items():
            shape += 0.1 * amount * diagonal * modes[mode] / modes[mode].norm(dim=-1).max()
        handles = self.handles[keyframe]
        if handles:
            vertices = list(handles)
            moves = (torch.stack(list(handles.values())) - shape[vertices]).reshape(-1)
            seen = modes[:, vertices].reshape(len(modes), -1)  # Phi_h^T, (k, 3m)
            soft = seen / self.eigenvalues[keyframe][:, None]
            compliance = seen.T @ soft
            slack = HANDLE_SLACK * compliance.diagonal().mean()
            forces = torch.linalg.solve(compliance + slack * torch.eye(len(moves), dtype=moves.dtype), moves)
            shape += torch.einsum("k,kvc->vc", soft @ forces, modes)
        self.keyframes[keyframe] = shape

    @torch.no_grad()
    def shape(self, time: float, accurate: bool = False) -> Tensor:
        """The shape at a time, in intervals of key-frames from 0 to K - 1. *Shape:* ``(V, 3)``.

        Args:
            time: 0.5 is half-way between the first two.
            accurate: Whether local steps on all vertices follow the modal solve.
        """
        return self._between(torch.tensor([time], dtype=torch.float64), accurate)[0]

    @torch.no_grad()
    def path(self, vertex: int, n_steps: int = 6) -> Tensor:
        """The path of a vertex, with so many steps an interval. *Shape:* ``((K-1) n_steps + 1, 3)``."""
        times = torch.linspace(0, len(self.given) - 1, (len(self.given) - 1) * n_steps + 1, dtype=torch.float64)
        return self._between(times, False)[:, vertex]

    def _between(self, times: Tensor, accurate: bool) -> Tensor:
        """*Shape:* ``(T,) -> (T, V, 3)``."""
        first = times.floor().long().clamp(0, len(self.given) - 2)
        layer = self._layers["accurate" if accurate else "fast"]
        found = layer.solve(self.keyframes[first], self.keyframes[first + 1], times - first, first).shapes
        # Linear interpolation where there is no solution, such as of inverted key-frames.
        straight = torch.lerp(self.keyframes[first], self.keyframes[first + 1], (times - first)[:, None, None])
        return torch.where(found.isfinite(), found, straight)
