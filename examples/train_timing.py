"""Learn to tell the time of a motion without a single label: the in-between layer is the decoder.

A hand closes. Sixteen markers on it are seen, with noise, at unknown times. A small network reads a time from the
markers, :class:`torch_modal.InBetween` decodes that time to a whole hand between the open and the closed one, and the
loss compares the decoded markers with the seen ones: all that the network learns, it learns through the layer. The same
network is trained with linear interpolation as its decoder, for comparison. Both are judged on frames that neither has
seen: how far the time is off, how far all vertices are off, and how far the edges have lost their length.

    python examples/train_timing.py [--steps 60]

The motion is that of the sample's own frames at 0, 1/4, 1/2, 3/4 and 1, which come from bones and not from the layer;
in training they are joined by straight lines. The fingers do not bend at the same time there, so that no path of one
parameter follows them exactly.
"""

import argparse
import time
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

import torch_modal as tm

TRUE_TIMES = torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)
Decoder = Callable[[Tensor], Tensor]


class Data(NamedTuple):
    """A motion that is seen through markers only. Lengths in bounding-box diagonals of the first key-frame."""

    keyframes: Tensor
    """Open and closed. *Shape:* ``(2, V, 3)``."""
    faces: Tensor
    """*Shape:* ``(F, 3)``."""
    markers: Tensor
    """Vertices that are seen. *Shape:* ``(M,)``."""
    seen: Tensor
    """Noisy markers at unknown times, to train on. *Shape:* ``(N, M, 3)``."""
    unseen: Tensor
    """Noisy markers of the true frames, some draws of the noise, to judge by. *Shape:* ``(R, 3, M, 3)``."""
    truth: Tensor
    """The true frames at 1/4, 1/2 and 3/4. *Shape:* ``(3, V, 3)``."""


class Learned(NamedTuple):
    """Results with one decoder, on frames that were not trained on."""

    losses: list[float]
    """Root mean square distance of the markers in each step, in percent of the bounding-box diagonal."""
    times: Tensor
    """Predicted times of the true frames, for each draw of the noise. *Shape:* ``(R, 3)``."""
    shapes: Tensor
    """The shapes decoded from the mean of those. *Shape:* ``(3, V, 3)``."""
    timing_error: float
    """Mean distance of the predicted from the true time; the motion takes 1."""
    vertex_error: float
    """Root mean square distance over all vertices, in percent of the bounding-box diagonal."""
    edge_error: float
    """Mean relative error of the edge lengths, in percent."""


class Result(NamedTuple):
    """Both decoders."""

    layer: Learned
    linear: Learned


def load_data(n_seen: int = 64, n_markers: int = 16, noise: float = 0.005, seed: int = 0) -> Data:
    """The sample, seen at random times.

    Args:
        n_seen: Number of shapes to train on.
        n_markers: Number of markers, spread evenly by farthest-point sampling.
        noise: Standard deviation of each coordinate, in bounding-box diagonals.
        seed: Of times and noise.
    """
    generator = torch.Generator().manual_seed(seed)
    sample = tm.load_sample("hand")
    diagonal = (sample.keyframes[0].amax(0) - sample.keyframes[0].amin(0)).norm()
    keyframes, truth = sample.keyframes / diagonal, sample.truth / diagonal
    markers = farthest_points(keyframes[0], n_markers)

    frames = torch.cat([keyframes[:1], truth, keyframes[1:]])[:, markers]
    place = torch.rand(n_seen, generator=generator, dtype=torch.float64) * (len(frames) - 1)
    left = place.long()
    seen = torch.lerp(frames[left], frames[left + 1], (place - left)[:, None, None])
    unseen = truth[:, markers].expand(8, -1, -1, -1)
    seen, unseen = (x + noise * torch.randn(x.shape, generator=generator, dtype=x.dtype) for x in (seen, unseen))
    return Data(keyframes, sample.faces, markers, seen, unseen, truth)


def farthest_points(x: Tensor, n: int, first: int | None = None) -> Tensor:
    """Vertices that are spread evenly: each is the farthest from those before; the first is that from the middle.

    *Shape:* ``(V, 3) -> (n,)``.
    """
    chosen = [int((x - x.mean(0)).norm(dim=1).argmax()) if first is None else first]
    distance = torch.full_like(x[:, 0], torch.inf)
    for _ in range(n - 1):
        distance = torch.minimum(distance, (x - x[chosen[-1]]).norm(dim=1))
        chosen.append(int(distance.argmax()))
    return torch.tensor(chosen)


class Encoder(nn.Module):
    """Reads a time from markers.

    Args:
        seen: Markers that give position and size. *Shape:* ``(N, M, 3)``.
        seed: Of the weights.
    """

    def __init__(self, seen: Tensor, seed: int) -> None:
        super().__init__()
        self.mean, self.spread = seen.mean(0), seen.std()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.layers = nn.Sequential(nn.Flatten(), nn.Linear(seen[0].numel(), 32), nn.Tanh(), nn.Linear(32, 1))
        self.to(seen.dtype)

    def forward(self, markers: Tensor) -> Tensor:
        """Times in (0, 1). *Shape:* ``(N, M, 3) -> (N,)``."""
        return self.layers((markers - self.mean) / self.spread).squeeze(-1).sigmoid()


def train(data: Data, decode: Decoder, steps: int, batch: int = 8, rate: float = 0.02, seed: int = 0) -> Learned:
    """Train an encoder through a decoder, and judge it.

    Args:
        data: Times are not in it.
        decode: From times ``(N,)`` to shapes ``(N, V, 3)``.
        steps: Steps of Adam.
        batch: Shapes in each step.
        rate: Learning rate at the start; it falls to zero along a cosine.
        seed: Of the encoder and of the batches.
    """
    encoder = Encoder(data.seen, seed)
    optimizer = torch.optim.Adam(encoder.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    generator = torch.Generator().manual_seed(seed)
    losses = []
    for _ in range(steps):
        seen = data.seen[torch.randperm(len(data.seen), generator=generator)[:batch]]
        decoded = decode(encoder(seen))[:, data.markers]
        loss = (decoded - seen).square().sum(-1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(100 * loss.item() ** 0.5)

    with torch.no_grad():
        times = encoder(data.unseen.flatten(0, 1)).unflatten(0, (-1, 3))
        shapes = decode(times.mean(0))
    lengths, true_lengths = edge_lengths(shapes, data.faces), edge_lengths(data.truth, data.faces)
    return Learned(
        losses,
        times,
        shapes,
        timing_error=float((times - TRUE_TIMES).abs().mean()),
        vertex_error=100 * float((shapes - data.truth).square().sum(-1).mean().sqrt()),
        edge_error=100 * float((lengths / true_lengths - 1).abs().mean()),
    )


def edge_lengths(x: Tensor, faces: Tensor) -> Tensor:
    """Lengths of the sides of all faces. *Shape:* ``(..., V, 3) -> (..., F, 3)``."""
    corners = x[..., faces, :]
    return (corners - corners.roll(1, -2)).norm(dim=-1)


def main(steps: int = 60, seed: int = 0) -> Result:
    """Train with both decoders.

    Args:
        steps: Steps of Adam.
        seed: Of all that is random.
    """
    data = load_data(seed=seed)
    x_a, x_b = data.keyframes
    layer = tm.InBetween(data.keyframes, data.faces, "fast")

    def through_layer(t: Tensor) -> Tensor:
        return layer(x_a, x_b, t)

    def straight(t: Tensor) -> Tensor:
        return torch.lerp(x_a, x_b, t[:, None, None])

    return Result(train(data, through_layer, steps, seed=seed), train(data, straight, steps, seed=seed))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=60)
    arguments = parser.parse_args()
    started = time.perf_counter()
    results = main(arguments.steps)
    print("                       markers first -> last   time off   vertices off   edges off")
    for name, learned in results._asdict().items():
        print(
            f"{name:20s} {learned.losses[0]:12.2f} % -> {learned.losses[-1]:.2f} %   {learned.timing_error:8.3f}   "
            f"{learned.vertex_error:10.2f} %   {learned.edge_error:7.2f} %"
        )
    print(f"{time.perf_counter() - started:.0f} s")
