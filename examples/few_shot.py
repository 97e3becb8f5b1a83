"""Five hundred shapes from six: how near do they come to shapes that were not given?

    python examples/few_shot.py [--out out/few-shot] [--n 500] [--rounds 1]

Six gestures of the sample hand are given, with each digit closed by an amount of its own; 24 others are the test. The
table tells how far each of these is from the nearest of the shapes that were made: the six themselves, mixtures of
their vertices, in-betweens of pairs, and members of ``tm.ShapeSpace``. As in GLASS (Muralikrishnan et al. 2022), an
auto-decoder may then learn the members and make the next round of shapes, from codes on the lines through pairs of its
own; here that brings nothing more. ``few-shot.png`` shows six of the test and what came nearest.
"""

import argparse
from pathlib import Path

import autodecoder
import numpy as np
import torch
from samples.make_samples import gesture, sculpted
from torch import Tensor

import torch_modal as tm

N_GIVEN, N_TEST, N_STEPS = 6, 24, 1500


def nearest(made: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest of the shapes made, moved rigidly, to each true one, and its mean distance.

    *Shape:* ``(N, V, 3), (M, V, 3) -> (M, V, 3), (M,)``.
    """
    closest = []
    for x in truth:
        moved = tm.align(made, x)
        closest.append(moved[(moved - x).norm(dim=-1).mean(1).argmin()])
    shapes = torch.stack(closest)
    return shapes, (shapes - truth).norm(dim=-1).mean(1)


def next_round(given: Tensor, made: Tensor, generator: torch.Generator) -> Tensor:
    """As many shapes again, by an auto-decoder of what was made. *Shape:* ``(K, V, 3), (N, V, 3) -> (N, V, 3)``."""
    shapes = torch.cat([given, made])
    shapes = tm.align(shapes, given[0])
    decoder, codes = autodecoder.train(shapes, torch.eye(len(shapes)), len(given), N_STEPS, None)
    i, j = torch.randint(len(codes), (2, len(made)), generator=generator)
    amounts = 2 * torch.rand(len(made), 1, generator=generator) - 0.5
    return torch.cat([decoder(part) for part in torch.lerp(codes[i], codes[j], amounts).split(50)]).to(given)


def main(out: Path, n: int = 500, rounds: int = 1) -> dict[str, float]:
    """Print the table; by kind of shapes, the mean distance over that of mixtures of vertices."""
    hand = sculpted("hand", gesture)
    x = torch.from_numpy(np.stack([hand.frame(i) for i in range(N_GIVEN + N_TEST)]))
    faces = torch.from_numpy(hand.faces).long()
    x = (x / (x[0].amax(0) - x[0].amin(0)).norm()).float()
    given, truth = x[:N_GIVEN], x[N_GIVEN:]
    space = tm.ShapeSpace(given, faces)
    generator = torch.Generator().manual_seed(0)
    mixed = -torch.rand(n, N_GIVEN, generator=generator, dtype=x.dtype).log()
    between = tm.RandomInBetween(p=1.0, space=space, generator=generator)
    made = {
        "given": given,
        "mixtures": torch.einsum("nk,kvc->nvc", mixed / mixed.sum(1, keepdim=True), given),
        "in-betweens": between(given[torch.arange(n) % N_GIVEN]),
        "members": space.sample(n, generator),
    }
    last = made["members"]
    for number in range(1, rounds + 1):
        last = made[f"round {number}"] = next_round(given, last, generator)
    matches = {name: nearest(shapes, truth) for name, shapes in made.items()}
    means = {name: float(distances.mean()) for name, (_, distances) in matches.items()}
    for name, mean in means.items():
        print(f"{name:<12}{100 * mean:6.2f} % of the diagonal, {mean / means['mixtures']:.2f} of mixtures' distance")
    six = [0, 1, 3, 4, 5, 6]
    shown = {name: matches[name][0][six] for name in ("given", "mixtures", "members")}
    out.mkdir(parents=True, exist_ok=True)
    tm.render_sequence(
        {"test": truth[six], **shown},
        faces,
        out / "few-shot.png",
        titles=[""] * 6,
        keyframe_indices=[],
        columns=range(6),
        colors={name: 100 * (y - truth[six]).norm(dim=-1) for name, y in shown.items()},
        color_label="distance from the test [% of the diagonal]",
    )
    print(f"picture: {out / 'few-shot.png'}")
    return {name: mean / means["mixtures"] for name, mean in means.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out") / "few-shot")
    parser.add_argument("--n", type=int, default=500)
    parser.add_argument("--rounds", type=int, default=1)
    given = parser.parse_args()
    main(given.out, given.n, given.rounds)
