"""Train a mesh auto-decoder on six poses of a walking animal, with each of the losses and with more shapes.

    python examples/autodecoder.py [--steps 1000]

A small network decodes a code for each pose of the sample creature. The true shapes between the poses are the test: the
best code for each (reconstruction), and the middle of the codes beside it (interpolation). Arms add to the training the
losses of ``tm.losses``, 300 shapes that ``ShapeSpace.sample`` draws, or 300 of ``tm.Path`` with codes between.
"""

import argparse
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

import torch_modal as tm
from torch_modal.data.samples import load_sample

N_CODE, N_MORE, BATCH = 8, 300, 24
Penalty = Callable[[nn.Module, Tensor, Tensor, Tensor], Tensor]  # of decoder, predictions, targets, a line of codes
ARMS = ("plain", "ShellLoss", "LatentElasticity", "path", "members", "in-betweens")


def decoder_of(mean: Tensor) -> nn.Module:
    """Codes into shapes, at first near the mean. *Shape:* ``(B, N_CODE) -> (B, V, 3)``."""
    layers = [nn.Linear(N_CODE, 64), nn.ELU(), nn.Linear(64, 128), nn.ELU(), nn.Linear(128, mean.numel())]
    layers[-1].weight.data *= 0.1
    layers[-1].bias.data = mean.flatten().clone()
    return nn.Sequential(*layers, nn.Unflatten(1, mean.shape))


def training_set(arm: str, poses: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """The poses and more shapes, and the codes of all as mixtures of those that are learned."""
    one, generator = torch.eye(len(poses)), torch.Generator().manual_seed(0)
    if arm == "members":
        return torch.cat([poses, tm.ShapeSpace(poses, faces).sample(N_MORE, generator)]), torch.eye(len(poses) + N_MORE)
    if arm == "in-betweens":
        t = len(poses) * torch.rand(N_MORE, generator=generator, dtype=poses.dtype)
        mixtures = torch.lerp(one[t.long()], one.roll(1, 1)[t.long()], t.frac()[:, None].float())
        return torch.cat([poses, tm.Path(poses, faces, cyclic=True)(poses, t)]), torch.cat([one, mixtures])
    return poses, one


def train(shapes: Tensor, mixtures: Tensor, n: int, steps: int, penalty: Penalty | None) -> tuple[nn.Module, Tensor]:
    """A decoder of shapes of size one, the first n of them poses of a cycle, and the codes that were learned."""
    torch.manual_seed(0)
    shapes, decoder = shapes.float(), decoder_of(shapes[:n].mean(0).float())
    learned = nn.Parameter(0.1 * torch.randn(mixtures.shape[1], N_CODE))
    optimizer = torch.optim.Adam([*decoder.parameters(), learned], lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        codes = mixtures @ learned
        own = torch.cat([torch.arange(n), n + torch.randperm(len(shapes) - n)[:BATCH]])
        predicted = decoder(codes[own])
        loss = (predicted - shapes[own]).abs().mean() + 1e-4 * codes[own].square().mean()
        if penalty is not None:
            i = int(torch.randint(n, ()))
            line = torch.lerp(codes[i], codes[(i + 1) % n], torch.linspace(0, 1, 5)[:, None])
            loss = loss + penalty(decoder, predicted, shapes[own], line)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return decoder.requires_grad_(False), learned.detach()


def penalties(faces: Tensor) -> dict[str, Penalty]:
    """What arms add to the loss."""
    shell = tm.losses.ShellLoss(faces).float()
    elastic = tm.losses.LatentElasticity(faces, directions=2).float()

    def path(x: Tensor) -> Tensor:
        return (len(x) - 1) * shell(x[1:], x[:-1]).sum()

    return {
        "ShellLoss": lambda decoder, predicted, wanted, line: 0.01 * shell(predicted, wanted).mean(),
        "LatentElasticity": lambda decoder, predicted, wanted, line: 0.001 * elastic(decoder, line[1:4]).mean(),
        "path": lambda decoder, predicted, wanted, line: 0.001 * path(decoder(line)),
    }


def errors(x: Tensor, truth: Tensor, faces: Tensor) -> list[float]:
    """Mean distance and mean relative error of the edges, both in percent."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].view(-1, 2).T
    lengths, true = ((y[:, edges[0]] - y[:, edges[1]]).norm(dim=-1) for y in (x, truth))
    return [100 * float((x - truth).norm(dim=-1).mean()), 100 * float(((lengths - true).abs() / true.mean()).mean())]


def test(decoder: nn.Module, codes: Tensor, truth: Tensor, faces: Tensor) -> list[float]:
    """Errors of reconstruction and of interpolation, against true shapes between the poses."""
    middles = 0.5 * (codes + codes.roll(-1, 0))
    z = middles.clone().requires_grad_()
    optimizer = torch.optim.LBFGS([z], max_iter=200, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss: Tensor = (decoder(z) - truth).square().sum(-1).mean(-1).sum()
        loss.backward()
        return loss

    optimizer.step(closure)  # type: ignore[no-untyped-call]
    return errors(decoder(z).detach(), truth, faces) + errors(decoder(middles), truth, faces)


def main(steps: int = 1000, arms: Sequence[str] = ARMS) -> dict[str, list[float]]:
    """Print the table: by arm, errors of reconstruction (distance, edges) and of interpolation."""
    sample, table = load_sample("creature"), {}
    faces, size = sample.faces, (sample.keyframes[0].amax(0) - sample.keyframes[0].amin(0)).norm()
    poses, truth = sample.keyframes / size, (sample.truth / size).float()
    print(f"{'%':<18}{'reconstruction, edges':>24}{'interpolation, edges':>24}")
    for arm in arms:
        decoder, codes = train(*training_set(arm, poses, faces), len(poses), steps, penalties(faces).get(arm))
        table[arm] = test(decoder, codes[: len(poses)], truth, faces)
        print(f"{arm:<18}" + "".join(f"{value:12.2f}" for value in table[arm]), flush=True)
    return table


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1000)
    main(parser.parse_args().steps)
