"""A mesh auto-decoder of few poses: plain, with augmentation, and with losses on its latent space.

    python tests/benchmarks/learning.py [--bodies fox trex] [--poses 16] [--seeds 2] [--arms plain samples]

A body's poses train a plain multi-layer perceptron with a code for each. They are pairs of frames a third of a second
apart (eight frames; with ``--apart 0`` single poses, those that follow in a clip being pairs), even over its clips.
Tested are 24 other frames (codes are optimised for each, from the nearest pose's) and the decoded middle of the codes
of each pair against the frame in the middle. Distances are means over the vertices, in percent of the diagonal; edges
are mean relative errors of length, in percent. Augmentation is by 600 further shapes: random convex mixtures
(``linear``), members that ``ShapeSpace.sample`` draws (``samples``), in-betweens of the pairs with the codes between
theirs (``in-betweens``), or half of each. ``ARAPReg`` is the regulariser of Huang et al. 2021 by its formula, square
roots of the spectrum of the as-rigid-as-possible Hessian with rotations eliminated, in our own code; ``elastic`` is
``LatentElasticity``. Both look at four codes, random mixtures of two, in every second step. ``shell`` adds
``ShellLoss`` against the targets. Means over bodies and seeds are geometric.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Callable
from itertools import combinations, pairwise

import numpy as np
import torch
from cases import animal
from measures import distance_and_edges
from timing import limit_threads
from torch import Tensor, nn

import torch_modal as tm
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.rigid import best_fit

N_CODE, N_MORE, N_TEST = 16, 600, 24
BATCH = 3
"""Further shapes in a step, over the number of poses."""
LEARNING_RATE, PRIOR = 2e-3, 1e-4
# Of the losses on the latent space, beside a mean distance in sizes of the body.
WEIGHTS = {"ARAPReg": 1e-3, "elastic": 1e-3, "shell": 1e-2}
OTHERS = ("plain", "linear", "ARAPReg")
ARMS = (*OTHERS, "shell", "elastic", "samples", "in-betweens", "samples + in-betweens")

Regulariser = Callable[[nn.Module, Tensor, torch.Generator], Tensor]


class Task:
    """A body: what is trained on, what is tested."""

    def __init__(self, body: str, n_poses: int, apart: int) -> None:
        frames, self.faces, clips = animal(body)
        starts = [*(start for _, start, _ in clips), len(frames)]
        frames = best_fit(frames, frames[0].expand_as(frames), torch.ones(frames.shape[1]).double()).apply(frames)
        self.size = float((frames[0].amax(0) - frames[0].amin(0)).norm())
        if apart:
            firsts = np.concatenate([np.arange(start, end - apart) for start, end in pairwise(starts)])
            firsts = firsts[np.linspace(0, len(firsts) - 1, n_poses // 2).round().astype(int)]
            places = np.unique([firsts, firsts + apart])
        else:
            places = np.unique(np.linspace(0, len(frames) - 1, n_poses).round().astype(int))
        clip = np.searchsorted(starts, places, side="right")
        self.pairs = [
            (i, j)
            for i, j in combinations(range(len(places)), 2)
            if clip[i] == clip[j] and (places[j] - places[i] == apart if apart else j == i + 1)
        ]
        self.middles = frames[[(places[i] + places[j]) // 2 for i, j in self.pairs]]
        rest = np.setdiff1d(np.arange(len(frames)), places)
        self.test = frames[rest[np.linspace(0, len(rest) - 1, N_TEST).round().astype(int)]]
        self.poses = frames[places]
        self.edges = torch.tensor(Connectivity(self.faces.numpy()).edges)

    def more(self, arm: str, seed: int) -> tuple[Tensor, Tensor]:
        """Shapes beside the poses, and the weights of the poses' codes for the first of them; others have their own."""
        generator, n = torch.Generator().manual_seed(seed), len(self.poses)
        share = N_MORE // (1 + (arm == "samples + in-betweens"))
        shapes, weights = [self.poses[:0]], [torch.zeros(0, n)]
        if arm == "linear":
            mixed = -torch.rand(N_MORE, n, generator=generator, dtype=torch.float64).log()
            shapes.append(torch.einsum("nk,kvc->nvc", mixed / mixed.sum(1, keepdim=True), self.poses))
        if "samples" in arm or "in-betweens" in arm:
            bases = tm.extract_bases(self.poses, self.faces, 10, progress=False)
            space = tm.ShapeSpace(bases, self.faces, preset="fast")
        if "in-betweens" in arm:
            each = share // len(self.pairs)
            for i, j in self.pairs:
                t = torch.rand(each, generator=generator)
                shapes.append(space.in_betweens.of_keyframes(i, j, t.double()).double())
                weights.append(torch.zeros(each, n).index_copy(1, torch.tensor([i, j]), torch.stack([1 - t, t], 1)))
        if "samples" in arm:
            shapes.append(space.sample(share, generator).double())
        found = torch.cat(shapes)
        masses = torch.ones(found.shape[1]).double()
        return best_fit(found, self.poses[0].expand_as(found), masses).apply(found), torch.cat(weights)

    def regulariser(self, arm: str) -> Regulariser | None:
        """On the latent space."""
        if arm == "ARAPReg":
            return self._rigidity
        if arm == "elastic":
            loss = tm.losses.LatentElasticity(self.faces, directions=4).float()
            return lambda decoder, z, generator: WEIGHTS["elastic"] * loss(decoder, z, generator).mean()
        return None

    def _rigidity(self, decoder: nn.Module, z: Tensor, generator: torch.Generator) -> Tensor:
        """Roots of the eigenvalues of the Hessian of as-rigid-as-possible energy, in four directions of the latent."""
        directions = torch.linalg.qr(torch.randn(N_CODE, 4, generator=generator))[0].mT
        pairs = [torch.func.jvp(decoder, (z,), (row.expand_as(z),)) for row in directions]
        x, moved = pairs[0][0], torch.stack([pair[1] for pair in pairs], 1)  # (B, V, 3), (B, k, V, 3)
        ends = torch.cat([self.edges, self.edges.flip(1)])
        edge = x[:, ends[:, 0]] - x[:, ends[:, 1]]
        change = moved[:, :, ends[:, 0]] - moved[:, :, ends[:, 1]]
        squares = edge.square().sum(-1)[..., None, None] * torch.eye(3) - edge[..., None] * edge[..., None, :]
        system = torch.zeros(*x.shape, 3).index_add(1, ends[:, 0], squares)
        torque = torch.linalg.cross(edge[:, None].expand_as(change), change)
        torque = torch.zeros_like(moved).index_add(2, ends[:, 0], torque)
        turns = torch.linalg.solve(system + 1e-6 * torch.eye(3), torque.movedim(1, -1)).movedim(-1, 1)
        gram = change.flatten(2) @ change.flatten(2).mT - torque.flatten(2) @ turns.flatten(2).mT
        values = torch.linalg.eigvalsh(gram / (len(ends) * squares.mean())).clamp_min(0)
        return WEIGHTS["ARAPReg"] * (values + 1e-6 * values.mean() + 1e-12).sqrt().mean()


def decoder_of(n_vertices: int, mean: Tensor) -> nn.Module:
    """Of codes into shapes of size one."""

    class Shapes(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            layers = [nn.Linear(N_CODE, 128), nn.ELU(), nn.Linear(128, 256), nn.ELU(), nn.Linear(256, 3 * n_vertices)]
            self.layers = nn.Sequential(*layers)

        def forward(self, z: Tensor) -> Tensor:
            return mean + 0.1 * self.layers(z).view(len(z), n_vertices, 3)

    return Shapes()


def trained(task: Task, arm: str, seed: int, steps: int) -> tuple[nn.Module, Tensor]:
    """A decoder, and the codes of the poses."""
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    further, weights = task.more(arm, seed)
    shapes, n = (torch.cat([task.poses, further]) / task.size).float(), len(task.poses)
    decoder = decoder_of(shapes.shape[1], shapes[:n].mean(0))
    free = nn.Parameter(0.1 * torch.randn(len(shapes) - len(weights), N_CODE, generator=generator))
    regularise = task.regulariser(arm)
    shell = tm.losses.ShellLoss(task.faces).float() if arm == "shell" else None
    optimizer = torch.optim.Adam([*decoder.parameters(), free], lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for step in range(steps):
        # In-betweens have the codes between those of their ends.
        codes = torch.cat([free[:n], weights @ free[:n], free[n:]])
        own = torch.arange(len(shapes))
        if len(shapes) > n:
            own = torch.cat([own[:n], n + torch.randperm(len(shapes) - n, generator=generator)[: BATCH * n]])
        loss = (decoder(codes[own]) - shapes[own]).abs().mean() + PRIOR * codes[own].square().mean()
        if shell is not None:
            loss = loss + WEIGHTS["shell"] * shell(decoder(codes[own]), shapes[own]).mean()
        if regularise is not None and step % 2 == 0:
            i, j = torch.randint(n, (2, 4), generator=generator)
            u = torch.rand(4, 1, generator=generator)
            loss = loss + regularise(decoder, torch.lerp(codes[i], codes[j], u), generator)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return decoder, free.detach()[:n]


def tested(task: Task, decoder: nn.Module, codes: Tensor) -> list[float]:
    """Distance and edges, of reconstruction and of interpolation."""
    decoder.requires_grad_(False)
    wanted = (task.test / task.size).float()
    with torch.no_grad():
        known = decoder(codes)
    nearest = torch.cdist(wanted.flatten(1), known.flatten(1)).argmin(1)
    z = codes[nearest].clone().requires_grad_()
    optimizer = torch.optim.LBFGS([z], max_iter=200, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        value: Tensor = (decoder(z) - wanted).square().sum(-1).mean(-1).sum() + 1e-6 * z.square().sum()
        value.backward()
        return value

    optimizer.step(closure)  # type: ignore[no-untyped-call]
    i, j = torch.tensor(task.pairs).T
    with torch.no_grad():
        middles = decoder(0.5 * (codes[i] + codes[j]))
        pairs = (decoder(z), task.test), (middles, task.middles)
        return [e for x, y in pairs for e in distance_and_edges(task.size * x.double(), y, task.faces, task.size)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bodies", nargs="+", default=["fox", "husky", "trex"], help="animals beside the repository")
    parser.add_argument("--poses", type=int, default=16)
    parser.add_argument(
        "--apart", type=int, default=8, help="frames between the poses of a pair; 0: even over the clips"
    )
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=ARMS)
    given = parser.parse_args()
    limit_threads()
    found: dict[str, list[list[float]]] = defaultdict(list)
    for body in given.bodies:
        task = Task(body, given.poses, given.apart)
        for arm in given.arms:
            for seed in range(given.seeds):
                start = time.process_time()
                made = trained(task, arm, seed, given.steps)
                found[arm].append([*tested(task, *made), time.process_time() - start])
            print(f"{body:<8}{arm:<20}" + "".join(f"{value:9.2f}" for value in found[arm][-1]), flush=True)
    print("| arm | reconstruction: distance | edges | interpolation: distance | edges | s |\n|---|---|---|---|---|---|")
    means = {arm: np.exp(np.log(rows).mean(0)) for arm, rows in found.items()}
    for arm, values in means.items():
        print(f"| {arm} | {' | '.join(f'{value:.2f}' for value in values)} |")
    groups = [[values for arm, values in means.items() if (arm in OTHERS) is old] for old in (True, False)]
    if all(groups):
        old, ours = (np.min(group, 0) for group in groups)
        print(f"best of ours over the best of the others: {', '.join(f'{value:.2f}' for value in (ours / old)[:4])}")


if __name__ == "__main__":
    main()
