"""A mesh auto-encoder of six poses: what 400 further shapes bring for poses that it has never seen.

    python tests/benchmarks/autoencoder.py [--bodies hand fox trex] [--poses 6] [--seeds 1] [--steps 800]

Bodies are the sample hand, with each digit closed by an amount of its own, and animated animals. The poses to train on
are far from each other: the first frame, then always the one that is farthest from those chosen. Tested are 24 other
frames, encoded and decoded: the mean distance of the vertices over the diagonal. All shapes are aligned with the first.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from cases import animal
from results import Table, add_keep
from timing import limit_threads
from torch import Tensor, nn

import torch_modal as tm
from torch_modal.geometry.rigid import best_fit

sys.path.append(str(Path(__file__).parents[2] / "examples"))
from samples.make_samples import gesture, sculpted
from train_timing import farthest_points

N_MORE, N_TEST, N_CODE, N_HIDDEN, BATCH = 400, 24, 16, 128, 16
DEGREES, NOISE = 10, 0.003
"""Of rotations, and of noise over the diagonal."""
ARMS = ("none", "rotation and noise", "linear, of pairs", "`RandomInBetween`", "`RandomBlend`", "`ShapeSpace.sample`")


def body(name: str) -> tuple[Tensor, Tensor]:
    """Frames of size one, and faces. *Shape:* ``(T, V, 3), (F, 3)``."""
    if name == "hand":
        made = sculpted("hand", gesture)
        x, faces = torch.tensor(np.stack([made.frame(t) for t in range(60)])), torch.tensor(made.faces).long()
    else:
        x, faces, _ = animal(name)
    x = best_fit(x, x[0].expand_as(x), torch.ones(x.shape[1]).double()).apply(x)
    return x / (x[0].amax(0) - x[0].amin(0)).norm(), faces


def further_shapes(arm: str, poses: Tensor, faces: Tensor, seed: int) -> Tensor:
    """Shapes that are trained on in addition to the poses. *Shape:* ``(N, V, 3)``."""
    generator = torch.Generator().manual_seed(seed)
    i, j = torch.stack([torch.randperm(len(poses), generator=generator)[:2] for _ in range(N_MORE)]).T
    if arm == "none":
        return poses[:0]
    if arm == "linear, of pairs":
        return torch.lerp(poses[i], poses[j], torch.rand(N_MORE, 1, 1, generator=generator, dtype=poses.dtype))
    if arm == "rotation and noise":
        turned = tm.RandomRigidMotion(degrees=DEGREES, p=1.0, generator=generator)(poses[i])
        return turned + NOISE * torch.randn(turned.shape, generator=generator, dtype=turned.dtype)
    space = tm.ShapeSpace(tm.extract_bases(poses, faces, 10, progress=False), faces)
    if arm == "`ShapeSpace.sample`":
        return space.sample(N_MORE, generator).to(poses)
    transform = tm.RandomInBetween if arm == "`RandomInBetween`" else tm.RandomBlend
    shapes: Tensor = transform(p=1.0, space=space, generator=generator)(poses[i])
    return shapes


def train(poses: Tensor, further: Tensor, seed: int, steps: int) -> nn.Module:
    """An auto-encoder of shapes ``(B, V, 3)``; a third of each batch are poses."""
    torch.manual_seed(seed)
    mean, size = poses.mean(0), poses[0].numel()
    encoder = nn.Sequential(nn.Flatten(), nn.Linear(size, N_HIDDEN), nn.ELU(), nn.Linear(N_HIDDEN, N_CODE))
    decoder = nn.Sequential(nn.Linear(N_CODE, N_HIDDEN), nn.ELU(), nn.Linear(N_HIDDEN, size))
    network = nn.Sequential(encoder, decoder, nn.Unflatten(1, mean.shape))
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        x = poses[torch.randint(len(poses), (BATCH if len(further) == 0 else BATCH // 3,), generator=generator)]
        if len(further):
            x = torch.cat([x, further[torch.randint(len(further), (BATCH - len(x),), generator=generator)]])
        loss = (network(x - mean) - (x - mean)).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network


def compare(name: str, n_poses: int, seeds: int, steps: int) -> list[float]:
    """Errors of the test poses in percent, by arm."""
    x, faces = body(name)
    chosen = farthest_points(x.flatten(1), n_poses, first=0)
    poses = x[chosen]
    others = torch.arange(len(x))[(x[:, None] - poses).abs().amax((2, 3)).amin(1) > 0]
    test = x[others[torch.linspace(0, len(others) - 1, N_TEST).round().long()]].float()
    errors = []
    for arm in ARMS:
        found = []
        for seed in range(seeds):
            further = further_shapes(arm, poses, faces, seed)
            if len(further) and arm != "rotation and noise":
                masses = torch.ones(further.shape[1]).double()
                further = best_fit(further, poses[0].expand_as(further), masses).apply(further)
            network, mean = train(poses.float(), further.float(), seed, steps), poses.float().mean(0)
            with torch.no_grad():
                found.append(float((network(test - mean) + mean - test).norm(dim=-1).mean()))
        errors.append(100 * float(np.mean(found)))
        print(f"({name}, {arm}: {errors[-1]:.2f} %)", flush=True)
    return errors


def main() -> None:
    """Print and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bodies", nargs="+", default=["hand", "fox", "trex"], help="hand, or animals of the data set")
    parser.add_argument("--poses", type=int, default=6)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--steps", type=int, default=800)
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    errors = [compare(name, given.poses, given.seeds, given.steps) for name in given.bodies]
    with Table("autoencoder", ["further shapes", *given.bodies], given.keep) as table:
        for arm, row in zip(ARMS, zip(*errors, strict=True), strict=True):
            table.add(arm, *(f"{error:.2f} %" for error in row))


if __name__ == "__main__":
    main()
