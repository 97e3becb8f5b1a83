"""Learn a motion from little: the next shape of a gallop from the last two, in amplitudes of vibration modes.

Animals gallop, each with a reach of its own in fore legs, hind legs and spine. A small network sees two shapes, as
short vectors, and the phase of the stride, and tells the next one; its loss is the distance of vertices. It is the same
network in four kinds of coordinates:

- *amplitudes*: :class:`torch_modal.ModalDecoder` makes shapes of them, and the loss goes through it. Its modes and its
  path are functions of the key-frames of one stride (``tm.encode``).
- *PCA*: as many components of the training shapes.
- *PCA beside the path*: as many components of what the training shapes have beside the same path.
- *vertices*: all coordinates.

All are judged on strides of other animals that none has seen: from their first two shapes, the rest of the stride is
predicted step by step.

    python examples/train_motion.py [--animals 4] [--steps 300] [--seeds 5] [--out out/motion.png]
"""

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import make_samples
import torch
from _sculpt import bind, place_bones, sculpt, skin
from scipy.spatial.transform import Rotation
from torch import Tensor, nn
from tqdm import tqdm
from train_timing import edge_lengths

import torch_modal as tm

N_FRAMES = 24
"""Of a stride."""
N_MODES, N_KEYFRAMES = 30, 4
N_TEST = 4
AHEAD = 4
"""Steps that are predicted one from the other in training."""
REACH = (0.7, 1.2)
"""All turns of the joints of fore legs, hind legs and spine, times numbers between these."""
HIDDEN = 64
RATES = {"vertices": 2e-3}
"""Of learning, where 5e-3 is not the best: tried were 2e-3, 5e-3 and 2e-2, each on the first seed."""
Decode = Callable[[Tensor, Tensor], Tensor]
"""From codes and frame numbers to shapes. *Shape:* ``(B, n), (B,) -> (B, V, 3)``."""


class Strides(NamedTuple):
    """Animals of one mesh that gallop. Lengths in bounding-box diagonals."""

    train: Tensor
    """*Shape:* ``(N, T, V, 3)``."""
    test: Tensor
    """*Shape:* ``(M, T, V, 3)``."""
    faces: Tensor
    """*Shape:* ``(F, 3)``."""


class Space(NamedTuple):
    """A kind of coordinates."""

    train: Tensor
    """*Shape:* ``(N, T, n)``."""
    test: Tensor
    """*Shape:* ``(M, T, n)``."""
    decode: Decode


class Learned(NamedTuple):
    """What one network has learned, on animals that were not trained on; in percent of the diagonal."""

    reconstruction: float
    """Mean distance of the vertices when the true codes are decoded: what the coordinates cannot hold."""
    one: float
    """Of the shape that follows two true ones."""
    stride: float
    """Of all shapes of a stride that is predicted from its first two."""
    edges: float
    """Mean relative error of their edge lengths."""
    shapes: Tensor
    """The stride of the first test animal. *Shape:* ``(T - 2, V, 3)``."""


def galloping(cell: float) -> tuple[Tensor, Callable[[Sequence[float], float], Tensor]]:
    """Faces of the sample creature, and its shape of any reach at any time of a stride, which takes six.

    Args:
        cell: Of the grid that the mesh is made from.
    """
    bones, flesh = make_samples.creature()
    rest, faces = sculpt(flesh, cell)
    weights, _ = bind(flesh, bones, rest, faces, softness=1.15)
    parts = {name: _part(name, bones) for name in bones}

    def posed(reach: Sequence[float], time: float) -> Tensor:
        turns, shift = make_samples.gallop(bones, time)
        scaled = {name: Rotation.from_rotvec(reach[parts[name]] * turn.as_rotvec()) for name, turn in turns.items()}
        return torch.from_numpy(skin(rest, weights, *place_bones(bones, scaled, shift)))

    return torch.from_numpy(faces), posed


def strides(n_train: int, cell: float, generator: torch.Generator) -> Strides:
    """Training and test animals, each with its own reach.

    Args:
        n_train: Number of training animals.
        cell: As for :func:`galloping`.
        generator: Of reaches.
    """
    faces, posed = galloping(cell)
    low, high = REACH
    reaches = low + (high - low) * torch.rand(n_train + N_TEST, 3, generator=generator, dtype=torch.float64)
    times = [6 * i / N_FRAMES for i in range(N_FRAMES)]
    x = torch.stack([torch.stack([posed(reach, time) for time in times]) for reach in reaches.tolist()])
    x = x / (x[0, 0].amax(0) - x[0, 0].amin(0)).norm()
    return Strides(x[:n_train], x[n_train:], faces)


def _part(name: str, bones: dict[str, make_samples.Bone]) -> int:
    """Fore leg, hind leg or spine."""
    chain = [name]
    while (parent := bones[chain[-1]].parent) is not None:
        chain.append(parent)
    legs = [0 if bone.startswith("scapula") else 1 for bone in chain if bone.startswith(("scapula", "thigh"))]
    return legs[0] if legs else 2


def spaces(data: Strides, n_modes: int) -> dict[str, Space]:
    """The four kinds of coordinates; all but vertices have as many numbers."""
    motion = tm.encode(data.train[0], data.faces, N_KEYFRAMES, n_modes, cyclic=True, progress=False)
    decoder = motion.decoder

    def amplitudes(strides: Tensor) -> Tensor:
        fits = [motion.fit(stride, motion.times) for stride in strides]
        return torch.stack([torch.cat([each.amplitudes, 100 * each.motions], 1) for each in fits])

    def bent(codes: Tensor, frames: Tensor) -> Tensor:
        return decoder(codes[:, :-6], frames.double(), codes[:, -6:] / 100)

    with torch.no_grad():
        path = decoder(torch.zeros(N_FRAMES, motion.n_modes).double(), motion.times)
    n = motion.n_modes + 6
    return {
        "amplitudes": Space(amplitudes(data.train), amplitudes(data.test), bent),
        "PCA": _pca(data, torch.zeros_like(path), n),
        "PCA beside the path": _pca(data, path, n),
        "vertices": Space(data.train.flatten(2), data.test.flatten(2), lambda x, _: x.unflatten(1, (-1, 3))),
    }


def _pca(data: Strides, base: Tensor, n: int) -> Space:
    """Components of what is left beside a base."""
    beside = (data.train - base).flatten(0, 1).flatten(1)
    mean = beside.mean(0)
    _, s, vh = torch.linalg.svd(beside - mean, full_matrices=False)
    components, scale = vh[:n], s[:n] / len(beside) ** 0.5 + 1e-9

    def coded(x: Tensor) -> Tensor:
        return ((x - base).flatten(2) - mean) @ components.mT / scale

    def decode(codes: Tensor, frames: Tensor) -> Tensor:
        return (mean + (codes * scale) @ components).unflatten(1, (-1, 3)) + base[frames]

    return Space(coded(data.train), coded(data.test), decode)


class Next(nn.Module):
    """The next code from the last two and the phase; before training, the last one.

    Args:
        codes: Of the training shapes. *Shape:* ``(N, T, n)``.
        seed: Of the weights.
    """

    def __init__(self, codes: Tensor, seed: int) -> None:
        super().__init__()
        flat, steps = codes.flatten(0, 1), codes.diff(dim=1).flatten(0, 1)
        self.mean, self.spread = flat.mean(0), flat.std() + 1e-12
        self.step = steps.std()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            first = nn.Linear(2 * codes.shape[2] + 2, HIDDEN)
            self.layers = nn.Sequential(first, nn.Tanh(), nn.Linear(HIDDEN, HIDDEN), nn.Tanh())
            self.last = nn.Linear(HIDDEN, codes.shape[2])
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self.double()

    def forward(self, before: Tensor, last: Tensor, frames: Tensor) -> Tensor:
        """Codes of frames. *Shape:* ``(B, n), (B, n), (B,) -> (B, n)``."""
        phase = 2 * torch.pi * frames.double() / N_FRAMES
        seen = [(last - self.mean) / self.spread, (last - before) / self.step]
        return last + self.step * self.last(
            self.layers(torch.cat([*seen, phase.sin()[:, None], phase.cos()[:, None]], 1))
        )


def predict(net: Next, codes: Tensor, first: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Codes that follow two, step by step, and their frame numbers. *Shape:* ``(B, 2, n), (B,)``."""
    before, last = codes.unbind(1)
    codes_after, frames = [], []
    for step in range(n):
        frame = (first + 2 + step) % N_FRAMES
        before, last = last, net(before, last, frame)
        codes_after.append(last)
        frames.append(frame)
    return torch.stack(codes_after, 1), torch.stack(frames, 1)


def train(data: Strides, space: Space, steps: int, batch: int = 6, rate: float = 5e-3, seed: int = 0) -> Learned:
    """Train a network in one kind of coordinates, and judge it."""
    net = Next(space.train, seed)
    optimizer = torch.optim.Adam(net.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    generator = torch.Generator().manual_seed(seed)
    for _ in tqdm(range(steps), desc="training", disable=None):
        animal = torch.randint(len(data.train), (batch,), generator=generator)
        first = torch.randint(N_FRAMES, (batch,), generator=generator)
        start = torch.stack([space.train[animal, first], space.train[animal, (first + 1) % N_FRAMES]], 1)
        codes, frames = predict(net, start, first, AHEAD)
        x = space.decode(codes.flatten(0, 1), frames.flatten())
        loss = (x - data.train[animal[:, None], frames].flatten(0, 1)).square().sum(-1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return judged(data, space, net)


@torch.no_grad()
def judged(data: Strides, space: Space, net: Next) -> Learned:
    """Errors on the test animals."""
    everything = torch.arange(N_FRAMES).expand(N_TEST, -1)

    def decoded(codes: Tensor, frames: Tensor) -> Tensor:
        return space.decode(codes.flatten(0, 1), frames.flatten()).unflatten(0, codes.shape[:2])

    def off(x: Tensor, truth: Tensor) -> float:
        return 100 * float((x - truth).norm(dim=-1).mean())

    reconstruction = off(decoded(space.test, everything), data.test)
    before, last = space.test[:, :-2].flatten(0, 1), space.test[:, 1:-1].flatten(0, 1)
    frames = everything[:, 2:].flatten()
    one = off(space.decode(net(before, last, frames), frames), data.test[:, 2:].flatten(0, 1))
    codes, frames = predict(net, space.test[:, :2], torch.zeros(N_TEST, dtype=torch.int64), N_FRAMES - 2)
    x, truth = decoded(codes, frames), data.test[:, 2:]
    lengths, true_lengths = edge_lengths(x, data.faces), edge_lengths(truth, data.faces)
    edges = 100 * float((lengths / true_lengths - 1).abs().mean())
    return Learned(reconstruction, one, off(x, truth), edges, x[0])


def draw(data: Strides, results: dict[str, Learned], out: Path) -> None:
    """Some shapes of the first test animal's stride in each kind of coordinates, coloured by their distance."""
    shown = torch.linspace(0, N_FRAMES - 2, 5).long()
    given = data.test[0, 1:2]
    truth = torch.cat([given, data.test[0, 2:]])[shown]
    predicted = {name: torch.cat([given, each.shapes])[shown] for name, each in results.items()}
    errors = {name: 100 * (x - truth).norm(dim=-1) for name, x in predicted.items()}
    label = "distance from the truth in % of the bounding box"
    out.parent.mkdir(parents=True, exist_ok=True)
    titles = ["given"] + [f"{step} steps" for step in shown[1:].tolist()]
    tm.render_sequence(
        {"truth": truth, **predicted},
        data.faces,
        out,
        titles=titles,
        keyframe_indices=[0],
        view=(0.0, 8.0),
        up="y",
        colors=errors,
        color_label=label,
    )


def main(
    n_animals: int = 4, steps: int = 300, seed: int = 0, cell: float = 0.04, n_modes: int = N_MODES
) -> tuple[Strides, dict[str, Learned]]:
    """Train in all kinds of coordinates.

    Args:
        n_animals: Number of training animals.
        steps: Steps of Adam.
        seed: Of animals, networks and batches.
        cell: Of the grid that the mesh is made from.
        n_modes: Amplitudes of a frame.
    """
    data = strides(n_animals, cell, torch.Generator().manual_seed(seed))
    results = {}
    for name, space in spaces(data, n_modes).items():
        results[name] = train(data, space, steps, rate=RATES.get(name, 5e-3), seed=seed)
    return data, results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--animals", type=int, default=4)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=None, metavar="FILE")
    arguments = parser.parse_args()
    print("| seed | coordinates | reconstruction | next shape | whole stride | its edges |\n|---|---|---|---|---|---|")
    for seed in range(arguments.seeds):
        started = time.process_time()
        data, results = main(arguments.animals, arguments.steps, seed)
        for name, each in results.items():
            numbers = [f"{x:.2f}" for x in (each.reconstruction, each.one, each.stride, each.edges)]
            print(f"| {seed} | {name} | {' | '.join(numbers)} |", flush=True)
        if arguments.out is not None and seed == 0:
            draw(data, results, arguments.out)
        print(f"({time.process_time() - started:.0f} s)", flush=True)
