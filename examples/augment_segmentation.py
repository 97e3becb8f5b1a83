"""Learn to tell the parts of a hand from two poses of it, and be tested on poses between them.

    python examples/augment_segmentation.py [--seeds 3] [--steps 400]

A small PointNet labels each point of a noisy, turned cloud of points with its bone. It learns from the two key-frames
of the sample hand, open and closed; ``linear`` adds shapes on straight lines between them, ``in-between`` those of
``tm.RandomInBetween``. All else is the same. Three true shapes between them, which none has seen, are the test.
"""

import argparse
from collections.abc import Sequence

import torch
from samples.make_samples import parts_of
from torch import Tensor, nn

import torch_modal as tm
from torch_modal.data.samples import load_sample

N_MORE, N_POINTS, BATCH, TURNS, NOISE = 300, 256, 16, 15.0, 0.005


class PointNet(nn.Module):
    """Each point is judged by its own place and by the maximum over all points (Qi et al. 2017), which is the pose."""

    def __init__(self, n_parts: int) -> None:
        super().__init__()
        self.local = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 64), nn.ReLU())
        self.whole = nn.Sequential(nn.Linear(64, 128), nn.ReLU())
        self.place, self.pose = nn.Linear(64, 96), nn.Linear(128, 96)
        self.head = nn.Sequential(nn.ReLU(), nn.Linear(96, 64), nn.ReLU(), nn.Linear(64, n_parts))

    def forward(self, points: Tensor) -> Tensor:
        """Scores. *Shape:* ``(B, n, 3) -> (B, n, parts)``."""
        local = self.local(points)
        pose = self.whole(local).amax(1)
        scores: Tensor = self.head(self.place(local) + self.pose(pose)[:, None])
        return scores


def clouds(x: Tensor, generator: torch.Generator, turns: float = TURNS) -> tuple[Tensor, Tensor]:
    """Noisy, turned points of shapes, centred and of size one, and which vertices they are.

    *Shape:* ``(B, V, 3) -> (B, n, 3), (B, n)``.
    """
    chosen = torch.rand(x.shape[:2], generator=generator).argsort(1)[:, :N_POINTS]
    points = x.float().gather(1, chosen[..., None].expand(-1, -1, 3))
    points = tm.RandomRigidMotion(degrees=turns, p=1.0, generator=generator)(points - points.mean(1, keepdim=True))
    points = points / points.norm(dim=-1).amax(1)[:, None, None]
    return points + NOISE * torch.randn(points.shape, generator=generator), chosen


def pool_of(arm: str, space: tm.ShapeSpace, seed: int = 0) -> Tensor:
    """The shapes that an arm learns from: one of five is a key-frame. *Shape:* ``(N, V, 3)``."""
    generator, keyframes = torch.Generator().manual_seed(seed), space.keyframes().float()
    transform = tm.RandomInBetween(p=1.0, space=space, generator=generator)
    i, j = torch.stack([torch.randperm(len(keyframes), generator=generator)[:2] for _ in range(N_MORE)]).T
    if arm == "none":
        return keyframes
    if arm == "linear":
        more = torch.lerp(keyframes[i], keyframes[j], torch.rand(N_MORE, 1, 1, generator=generator))
    else:
        more = transform(keyframes[i])
    return torch.cat([keyframes.repeat(N_MORE // (4 * len(keyframes)), 1, 1), more])


def trained(pool: Tensor, parts: Tensor, seed: int, steps: int, turns: float = TURNS) -> PointNet:
    """A network that labels points of the shapes of a pool. *Shape:* ``(N, V, 3), (V,)``."""
    torch.manual_seed(seed)
    network, generator = PointNet(int(parts.max()) + 1), torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-2, steps)
    for _ in range(steps):
        points, chosen = clouds(pool[torch.randint(len(pool), (BATCH,), generator=generator)], generator, turns)
        loss = nn.functional.cross_entropy(network(points).mT, parts[chosen])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network


@torch.no_grad()
def mean_iou(network: PointNet, shapes: Tensor, parts: Tensor, rounds: int = 20) -> float:
    """Intersection over union, mean over the parts, of the same clouds for every network."""
    generator, n = torch.Generator().manual_seed(12345), int(parts.max()) + 1
    confusion = torch.zeros(n * n)
    for _ in range(rounds):
        points, chosen = clouds(shapes, generator)
        confusion += torch.bincount((parts[chosen] * n + network(points).argmax(-1)).flatten(), minlength=n * n)
    confusion = confusion.reshape(n, n)
    both = confusion.diagonal()
    return float((both / (confusion.sum(0) + confusion.sum(1) - both)).nanmean())


def main(seeds: int = 3, steps: int = 400, arms: Sequence[str] = ("none", "linear", "in-between")) -> dict[str, Tensor]:
    """Print the table; by arm, the mean IoU of each seed."""
    sample = load_sample("hand")
    parts = torch.from_numpy(parts_of("hand", sample.keyframes[0].numpy()))
    space = tm.ShapeSpace(tm.extract_bases(sample.keyframes, sample.faces, n_modes=30), sample.faces)
    scores = {}
    for arm in arms:
        networks = [trained(pool_of(arm, space), parts, seed, steps) for seed in range(seeds)]
        scores[arm] = torch.tensor([mean_iou(network, sample.truth, parts) for network in networks])
        print(f"{arm:<12}{100 * scores[arm].mean():6.1f} ± {100 * scores[arm].std(correction=0):.1f} % IoU", flush=True)
    return scores


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=400)
    given = parser.parse_args()
    main(given.seeds, given.steps)
