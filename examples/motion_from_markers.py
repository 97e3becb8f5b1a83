"""A whole motion from key-frames and the noisy trajectories of 20 vertices.

    python examples/motion_from_markers.py [--frames 24] [--steps 20] [--seeds 0 1 2]
    python examples/motion_from_markers.py --meshes frame-*.obj

The sample creature gallops, or the meshes of a motion are given; known are three key-frames of the cycle, or the first
and the last mesh, and where 20 vertices are in every frame, with noise of 1 % of the diagonal and a tenth of them lost.
Amplitudes, times and rigid motions of all frames are fitted through the differentiable decoder
(:class:`torch_modal.ModalDecoder`), with the elastic energy of the modes and smoothness in time as the prior. Compared
with PCA of the key-frames fitted to the same markers, and with the smooth path through the key-frames without any
marker. Errors are mean distances of all vertices, in % of the diagonal.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
import trimesh
from _sculpt import bind, place_bones, restore_volume, sculpt, skin
from make_samples import SAMPLES
from torch import Tensor
from tqdm import tqdm
from train_timing import farthest_points

import torch_modal as tm
from torch_modal.geometry.rigid import best_fit

N_MODES, N_MARKERS = 30, 20
NOISE, LOST = 0.01, 0.1
STIFFEST = 3.0
"""Prior deviation of the softest mode's amplitude; a stiffer one has it less by the ratio of their frequencies."""
JERK = 0.07
"""Prior deviation of second differences in time, over that of the amplitude itself, at 16 frames from key-frame to
key-frame."""
LATE = 0.02
"""Prior deviation of a time, over that from key-frame to key-frame."""


class Problem(NamedTuple):
    """What is known, and the truth."""

    frames: Tensor
    """The truth. *Shape:* ``(T, V, 3)``."""
    faces: Tensor
    keys: list[int]
    cyclic: bool
    chosen: Tensor
    """Vertices that are followed. *Shape:* ``(M,)``."""
    markers: Tensor
    """*Shape:* ``(T, M, 3)``."""
    seen: Tensor
    """*Shape:* ``(T, M)``."""
    diagonal: float

    def error(self, x: Tensor) -> float:
        """Mean distance of all vertices of the frames that are not known, over the diagonal."""
        rest = [f for f in range(len(self.frames)) if f not in self.keys]
        return float((x - self.frames)[rest].norm(dim=-1).mean()) / self.diagonal


def gallop(n_frames: int) -> tuple[Tensor, Tensor]:
    """Frames of a cycle, and faces."""
    model, motion, cell, softness, _ = SAMPLES["creature"]
    bones, flesh = model()
    rest, faces = sculpt(flesh, cell)
    weights, radius = bind(flesh, bones, rest, faces, softness)
    volume = trimesh.Trimesh(rest, faces, process=False).volume

    def posed(time: float) -> Tensor:
        shape = skin(rest, weights, *place_bones(bones, *motion(bones, time)))
        return torch.from_numpy(restore_volume(shape, faces, volume, radius))

    return torch.stack([posed(6 * i / n_frames) for i in range(n_frames)]), torch.from_numpy(faces)


def problem(frames: Tensor, faces: Tensor, keys: list[int], cyclic: bool, generator: torch.Generator) -> Problem:
    """Markers far from each other."""
    diagonal = float((frames[0].amax(0) - frames[0].amin(0)).norm())
    chosen = farthest_points(frames[0], N_MARKERS, first=0)
    noise = torch.randn(len(frames), N_MARKERS, 3, generator=generator, dtype=torch.float64) / 3**0.5
    seen = torch.rand(len(frames), N_MARKERS, generator=generator) > LOST
    markers = frames[:, chosen] + NOISE * diagonal * noise
    return Problem(frames, faces, keys, cyclic, chosen, markers, seen, diagonal)


def by_amplitudes(known: Problem, steps: int) -> tuple[Tensor, Tensor]:
    """The path alone, and the motion fitted to the markers. *Shape of each:* ``(T, V, 3)``."""
    n = len(known.frames)
    keyframes = known.frames[known.keys]
    basis = tm.extract_modes(keyframes[0], known.faces, N_MODES, mesher="lattice")
    times = torch.tensor([*known.keys, n] if known.cyclic else known.keys, dtype=torch.float64)
    decoder = tm.ModalDecoder(keyframes, known.faces, times, basis.reference, basis.modes)
    t = torch.arange(n, dtype=torch.float64)
    free = torch.ones(n, 1, dtype=torch.float64)
    free[known.keys] = 0  # these frames are known
    deviation = STIFFEST * (basis.eigenvalues[0] / basis.eigenvalues).sqrt()
    # All unknowns are in units of their prior deviation.
    unknown = torch.zeros(n, N_MODES + 7, dtype=torch.float64, requires_grad=True)
    scales = torch.cat([deviation, torch.full((7,), 0.05, dtype=torch.float64)])
    between = float(times[-1] - times[0]) / (len(times) - 1)  # frames from key-frame to key-frame
    scales[N_MODES] = LATE * between
    jerk = JERK * (16 / between) ** 2

    def decoded(z: Tensor) -> Tensor:
        a, dt, motions = (free * z * scales).split([N_MODES, 1, 6], 1)
        late = t + dt[:, 0]
        return decoder(a, late if known.cyclic else late.clamp(times[0], times[-1]), motions)

    def objective(z: Tensor) -> Tensor:
        apart = (decoded(z)[:, known.chosen] - known.markers) / (NOISE * known.diagonal / 3**0.5)
        data = (apart.square().sum(-1) * known.seen).sum()
        bent = (torch.roll(z, 1, 0) - 2 * z + torch.roll(z, -1, 0)) / jerk
        return data + z.square().sum() + (bent if known.cyclic else bent[1:-1]).square().sum()

    solver = torch.optim.LBFGS([unknown], max_iter=1, history_size=20, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        solver.zero_grad()
        value = objective(unknown)
        value.backward()
        return value

    for _ in tqdm(range(steps), desc="fit", disable=None):
        solver.step(closure)
    with torch.no_grad():
        return decoded(0 * unknown), decoded(unknown)


def by_pca(known: Problem) -> Tensor:
    """Mean and components of the key-frames, with their deviations as the prior, and a rigid motion, alternately."""
    keyframes = known.frames[known.keys]
    shapes = tm.align(keyframes, keyframes[0])
    mean = shapes.mean(0)
    _, s, vh = torch.linalg.svd((shapes - mean).flatten(1), full_matrices=False)
    n = len(shapes) - 1
    components = ((s[:n] / n**0.5)[:, None] * vh[:n]).unflatten(1, (-1, 3))
    out = []
    for markers, seen in zip(known.markers, known.seen, strict=True):
        rows = known.chosen[seen]
        own, wanted = components[:, rows].flatten(1).mT, markers[seen]
        c = torch.zeros(n, dtype=torch.float64)
        for _ in range(20):
            x = mean + torch.tensordot(c, components, 1)
            back = best_fit(wanted, x[rows])
            apart = (back.apply(wanted) - mean[rows]).flatten()
            ridge = (NOISE * known.diagonal) ** 2 / 3 * torch.eye(n, dtype=torch.float64)
            c = torch.linalg.solve(own.mT @ own + ridge, own.mT @ apart)
        out.append(back.inverse().apply(mean + torch.tensordot(c, components, 1)))
    return torch.stack(out)


def main(
    n_frames: int = 24, steps: int = 20, seed: int = 0, meshes: Sequence[str | Path] | None = None
) -> dict[str, float]:
    """Errors of all ways, over the diagonal.

    Args:
        n_frames: Of the sample creature's cycle.
        steps: Of the fit.
        seed: Of noise and of what is lost.
        meshes: Of a motion, in the place of the sample's.
    """
    if meshes is None:
        (frames, faces), keys = gallop(n_frames), [0, n_frames // 3, 2 * n_frames // 3]
    else:
        frames, faces = tm.load_keyframes(meshes)
        keys = [0, len(frames) - 1]
    known = problem(frames, faces, keys, meshes is None, torch.Generator().manual_seed(seed))
    path, fitted = by_amplitudes(known, steps)
    return {"path": known.error(path), "PCA": known.error(by_pca(known)), "amplitudes": known.error(fitted)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--meshes", type=Path, nargs="+")
    args = parser.parse_args()
    for seed in args.seeds:
        errors = main(args.frames, args.steps, seed, args.meshes)
        print(f"seed {seed}: " + ", ".join(f"{name} {100 * error:.2f}" for name, error in errors.items()), flush=True)
