"""A whole motion from key-frames and the noisy trajectories of 20 vertices.

    python examples/motion_from_markers.py [--steps 20] [--seeds 0 1 2] [--meshes frame-*.obj]

The sample creature gallops, or the meshes of a motion are given; known are three key-frames of the cycle, or the first
and the last mesh, and where 20 vertices are in every frame, with noise of 1 % of the diagonal and a tenth of them lost.
Amplitudes, times and rigid motions of all frames are fitted through the differentiable decoder
(:class:`torch_modal.ModalDecoder`), with the elastic energy of the modes and smoothness in time as the prior. Compared
are PCA of the key-frames, fitted to the same markers, and the path without markers, by the mean distance of vertices.
"""

import argparse

import numpy as np
import torch
from samples.make_samples import sculpted
from torch import Tensor
from tqdm import tqdm
from train_timing import farthest_points

import torch_modal as tm
from torch_modal.geometry.rigid import best_fit

N_MODES, N_MARKERS, NOISE, LOST = 30, 20, 0.01, 0.1
STIFFEST = 3.0  # prior deviation of the softest mode's amplitude; a stiffer one has it less as its frequency is higher
MOTION = 0.05  # prior deviation of rigid motions
LATE = 0.02  # prior deviation of a time, over that from key-frame to key-frame
JERK = 0.07  # prior deviation of second differences, over that of the amplitude, at 16 frames between key-frames


def by_amplitudes(
    keyframes: Tensor, faces: Tensor, times: Tensor, markers: Tensor, chosen: Tensor, noise: float, steps: int
) -> tuple[Tensor, Tensor]:
    """The path alone, and the motion fitted to markers ``(T, M, 3)``, NaN where lost. *Shape of each:* ``(T, V, 3)``.

    Times of the key-frames are frame numbers; of a cycle, one more, when the first key-frame comes again.
    """
    cyclic = len(times) > len(keyframes)
    basis = tm.extract_modes(keyframes[0], faces, N_MODES, mesher="lattice")
    decoder = tm.ModalDecoder(keyframes, faces, times, basis.reference, basis.modes)
    t = torch.arange(len(markers), dtype=torch.float64)
    free = ~torch.isin(t, times)[:, None]
    between = (times[-1] - times[0]) / (len(times) - 1)
    # All unknowns are in units of their prior deviation.
    deviation = STIFFEST * (basis.eigenvalues[0] / basis.eigenvalues).sqrt()
    scales = torch.cat([deviation, LATE * between[None], torch.full((6,), MOTION, dtype=torch.float64)])
    jerk = JERK * (16 / between) ** 2
    unknown = torch.zeros(len(t), len(scales), dtype=torch.float64, requires_grad=True)
    solver = torch.optim.LBFGS([unknown], max_iter=1, history_size=20, line_search_fn="strong_wolfe")

    def decoded(z: Tensor) -> Tensor:
        amplitudes, late, motions = (free * z * scales).split([N_MODES, 1, 6], 1)
        when = t + late[:, 0]
        return decoder(amplitudes, when if cyclic else when.clamp(times[0], times[-1]), motions)

    def closure() -> Tensor:
        solver.zero_grad()
        apart = (decoded(unknown)[:, chosen] - markers)[~markers.isnan()] / noise
        bent = (unknown.roll(1, 0) - 2 * unknown + unknown.roll(-1, 0)) / jerk
        smoothness = (bent if cyclic else bent[1:-1]).square().sum()
        loss = apart.square().sum() + unknown.square().sum() + smoothness
        loss.backward()
        return loss

    for _ in tqdm(range(steps), desc="fit", disable=None):
        solver.step(closure)
    with torch.no_grad():
        return decoded(0 * unknown), decoded(unknown)


def by_pca(keyframes: Tensor, markers: Tensor, chosen: Tensor, noise: float) -> Tensor:
    """Components of the key-frames, with their deviations as the prior, and rigid motions, by turns: ``(T, V, 3)``."""
    shapes = tm.align(keyframes, keyframes[0])
    mean, n = shapes.mean(0), len(shapes) - 1
    _, s, vh = torch.linalg.svd((shapes - mean).flatten(1), full_matrices=False)
    components = ((s[:n] / n**0.5)[:, None] * vh[:n]).unflatten(1, (-1, 3))
    out = []
    for frame in markers:
        seen = ~frame.isnan().any(1)
        rows, x = chosen[seen], mean
        own = components[:, rows].flatten(1).mT
        for _ in range(20):
            back = best_fit(frame[seen], x[rows])
            right = own.mT @ (back.apply(frame[seen]) - mean[rows]).flatten()
            c = torch.linalg.solve(own.mT @ own + noise**2 * torch.eye(n, dtype=torch.float64), right)
            x = mean + torch.tensordot(c, components, 1)
        out.append(back.inverse().apply(x))
    return torch.stack(out)


def main(steps: int = 20, seed: int = 0, meshes: list[str] | None = None) -> dict[str, float]:
    """Errors of all ways over the frames that are not known, over the diagonal; of 24 frames of the sample's cycle."""
    if meshes is None:
        body = sculpted("creature")
        frames, faces = torch.from_numpy(np.stack([body.frame(i / 4) for i in range(24)])), torch.from_numpy(body.faces)
        keys, times = [0, 8, 16], torch.tensor([0.0, 8, 16, 24]).double()
    else:
        frames, faces = tm.load_keyframes(meshes)
        keys, times = [0, len(frames) - 1], torch.tensor([0, len(frames) - 1]).double()
    generator = torch.Generator().manual_seed(seed)
    diagonal = float((frames[0].amax(0) - frames[0].amin(0)).norm())
    noise = NOISE * diagonal / 3**0.5  # of each coordinate
    chosen = farthest_points(frames[0], N_MARKERS, first=0)
    markers = frames[:, chosen] + noise * torch.randn(len(frames), N_MARKERS, 3, generator=generator).double()
    markers[torch.rand(len(frames), N_MARKERS, generator=generator) < LOST] = torch.nan
    keyframes, unknown = frames[keys], [i for i in range(len(frames)) if i not in keys]
    path, fitted = by_amplitudes(keyframes, faces, times, markers, chosen, noise, steps)
    ways = {"path": path, "PCA": by_pca(keyframes, markers, chosen, noise), "amplitudes": fitted}
    return {name: float((x - frames)[unknown].norm(dim=-1).mean()) / diagonal for name, x in ways.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--meshes", nargs="+")
    args = parser.parse_args()
    for seed in args.seeds:
        errors = main(args.steps, seed, args.meshes)
        print(f"seed {seed}: " + ", ".join(f"{name} {100 * error:.2f}" for name, error in errors.items()), flush=True)
