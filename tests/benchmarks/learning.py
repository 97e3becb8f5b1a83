"""A mesh auto-decoder of few poses: plain, with further shapes, and with a loss on its latent space.

    python tests/benchmarks/learning.py [--bodies fox trex] [--poses 16] [--seeds 1] [--steps 2000]

A body's poses train a plain multi-layer perceptron with a code for each. They are pairs of frames a third of a second
apart (eight frames), even over its clips. Tested are 24 other frames (codes are optimised for each, from the nearest
pose's) and the decoded middle of the codes of each pair against the frame in the middle. Distances are means over the
vertices, over the diagonal; edges are mean relative errors of length. Further shapes are 600: random convex mixtures,
members that ``ShapeSpace.sample`` draws, in-betweens of the pairs with the codes between theirs, or half of each of the
last two. ``LatentElasticity`` looks at four codes, random mixtures of two, in every second step. Means over bodies and
seeds are geometric.
"""

import argparse
import time
from itertools import combinations, pairwise

import numpy as np
import torch
from cases import animal
from measures import distance_and_edges
from results import Table, add_keep
from timing import limit_threads
from torch import Tensor, nn

import torch_modal as tm
from torch_modal.geometry.rigid import best_fit

N_CODE, N_MORE, N_TEST = 16, 600, 24
BATCH = 3
"""Further shapes in a step, over the number of poses."""
LEARNING_RATE, PRIOR = 2e-3, 1e-4
ELASTIC = 1e-3
"""Weight of ``LatentElasticity``, beside a mean distance in sizes of the body."""
APART = 8
"""Frames between the poses of a pair."""
ARMS = {
    "plain": "none",
    "linear": "linear mixtures",
    "elastic": "none, `LatentElasticity`",
    "samples": "members of `ShapeSpace.sample`",
    "in-betweens": "in-betweens of the pairs",
    "samples + in-betweens": "half members, half in-betweens",
}
COLUMNS = ["further shapes", "reconstruction: distance", "edges", "interpolation: distance", "edges", "training"]


class Task:
    """A body: what is trained on, what is tested."""

    def __init__(self, body: str, n_poses: int) -> None:
        frames, self.faces, clips = animal(body)
        starts = [*(start for _, start, _ in clips), len(frames)]
        frames = best_fit(frames, frames[0].expand_as(frames), torch.ones(frames.shape[1]).double()).apply(frames)
        self.size = float((frames[0].amax(0) - frames[0].amin(0)).norm())
        firsts = np.concatenate([np.arange(start, end - APART) for start, end in pairwise(starts)])
        firsts = firsts[np.linspace(0, len(firsts) - 1, n_poses // 2).round().astype(int)]
        places = np.unique([firsts, firsts + APART])
        clip = np.searchsorted(starts, places, side="right")
        self.pairs = [
            (i, j)
            for i, j in combinations(range(len(places)), 2)
            if clip[i] == clip[j] and places[j] - places[i] == APART
        ]
        self.middles = frames[[(places[i] + places[j]) // 2 for i, j in self.pairs]]
        rest = np.setdiff1d(np.arange(len(frames)), places)
        self.test = frames[rest[np.linspace(0, len(rest) - 1, N_TEST).round().astype(int)]]
        self.poses = frames[places]

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
    elasticity = tm.losses.LatentElasticity(task.faces, directions=4).float() if arm == "elastic" else None
    optimizer = torch.optim.Adam([*decoder.parameters(), free], lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for step in range(steps):
        # In-betweens have the codes between those of their ends.
        codes = torch.cat([free[:n], weights @ free[:n], free[n:]])
        own = torch.arange(len(shapes))
        if len(shapes) > n:
            own = torch.cat([own[:n], n + torch.randperm(len(shapes) - n, generator=generator)[: BATCH * n]])
        loss = (decoder(codes[own]) - shapes[own]).abs().mean() + PRIOR * codes[own].square().mean()
        if elasticity is not None and step % 2 == 0:
            i, j = torch.randint(n, (2, 4), generator=generator)
            u = torch.rand(4, 1, generator=generator)
            loss = loss + ELASTIC * elasticity(decoder, torch.lerp(codes[i], codes[j], u), generator).mean()
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
    """Print and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bodies", nargs="+", default=["fox", "trex"], help="animals beside the repository")
    parser.add_argument("--poses", type=int, default=16)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--steps", type=int, default=2000)
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    tasks = [Task(body, given.poses) for body in given.bodies]
    with Table("learning", COLUMNS, given.keep, COLUMNS[-1:]) as table:
        for arm, name in ARMS.items():
            found = []
            for task in tasks:
                for seed in range(given.seeds):
                    start = time.process_time()
                    made = trained(task, arm, seed, given.steps)
                    seconds = time.process_time() - start
                    found.append([*tested(task, *made), seconds])
            *errors, seconds = np.exp(np.log(found).mean(0))
            table.add(name, *(f"{error:.2f} %" for error in errors), f"{seconds:.0f} s")


if __name__ == "__main__":
    main()
