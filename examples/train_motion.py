"""Learn a motion from little: the next shape of a gallop from the last two, in amplitudes of vibration modes.

    python examples/train_motion.py [--animals 4] [--steps 300] [--seed 0] [--out out/motion.png]

Animals gallop, each with its own reach in fore legs, hind legs and spine. A small network sees two shapes, as codes,
and the phase of the stride, and predicts the next; its loss is the distance of vertices. It is the same network for
amplitudes, from which :class:`torch_modal.ModalDecoder` makes shapes (``tm.encode``: its modes and path come from one
stride), for as many components of PCA, of shapes or of their differences from the same path, and for all coordinates.
Judged are strides of other animals, each predicted step by step from its first two shapes.
"""

import argparse
from collections.abc import Callable

import torch
from samples.animals import strides
from torch import Tensor, nn
from tqdm import tqdm
from train_timing import edge_lengths

import torch_modal as tm

N_FRAMES, N_KEYFRAMES, N_TEST, AHEAD, BATCH, HIDDEN = 24, 4, 4, 4, 6, 64
RATES = {"vertices": 2e-3}  # of learning, where 5e-3 is not the best of 2e-3, 5e-3 and 2e-2 on the first seed
Kind = tuple[Tensor, Callable[[Tensor, Tensor], Tensor]]  # codes (N, T, n); (..., n), (...) frames -> (..., V, 3)


def spaces(x: Tensor, faces: Tensor, n_train: int, n_modes: int) -> dict[str, Kind]:
    """Codes ``(N, T, n)`` of strides in the four kinds of coordinates, and their decoders."""
    motion = tm.encode(x[0], faces, N_KEYFRAMES, n_modes, cyclic=True, progress=False)
    n = motion.n_modes + 6
    fits = [motion.fit(stride, motion.times) for stride in x]
    amplitudes = torch.stack([torch.cat([fit.amplitudes, 100 * fit.motions], 1) for fit in fits])

    def decode(codes: Tensor, frames: Tensor) -> Tensor:
        return motion.decoder(codes[..., :-6], frames.double(), codes[..., -6:] / 100)

    def pca(base: Tensor) -> Kind:
        beside = (x - base).flatten(2)
        mean = beside[:n_train].mean((0, 1))
        _, s, vh = torch.linalg.svd((beside[:n_train] - mean).flatten(0, 1), full_matrices=False)
        scaled = (s[:n, None] / (n_train * N_FRAMES) ** 0.5 + 1e-9) * vh[:n]
        codes = (beside - mean) @ torch.linalg.pinv(scaled)
        return codes, lambda c, frames: (mean + c @ scaled).unflatten(-1, (-1, 3)) + base[frames]

    path = decode(torch.zeros(N_FRAMES, n).double(), torch.arange(N_FRAMES)).detach()
    kinds = {"amplitudes": (amplitudes, decode), "PCA": pca(0 * path), "PCA beside the path": pca(path)}
    return {**kinds, "vertices": (x.flatten(2), lambda codes, frames: codes.unflatten(-1, (-1, 3)))}


class Next(nn.Module):
    """Codes ``(B, steps, n)`` after two ``(B, 2, n)``, each from the two before and the phase; and frame numbers."""

    def __init__(self, codes: Tensor, seed: int) -> None:
        super().__init__()
        n = codes.shape[2]
        self.mean, self.spread, self.step = codes.mean((0, 1)), codes.std(), codes.diff(dim=1).std()
        torch.manual_seed(seed)
        hidden = [nn.Linear(2 * n + 2, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, HIDDEN), nn.Tanh()]
        self.layers = nn.Sequential(*hidden, nn.Linear(HIDDEN, n)).double()

    def forward(self, codes: Tensor, first: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Predict step by step; ``first`` ``(B,)`` are the numbers of the first frames."""
        frames = (first[:, None] + 2 + torch.arange(steps)) % N_FRAMES
        for phase in (2 * torch.pi * frames.double() / N_FRAMES).T[..., None]:
            before, last = codes[:, -2], codes[:, -1]
            seen = [(last - self.mean) / self.spread, (last - before) / self.step, phase.sin(), phase.cos()]
            codes = torch.cat([codes, (last + self.step * self.layers(torch.cat(seen, 1)))[:, None]], 1)
        return codes[:, 2:], frames


def learn(x: Tensor, faces: Tensor, kind: Kind, steps: int, rate: float, seed: int) -> tuple[dict[str, float], Tensor]:
    """Train on all but the last animals; errors on these in % of the diagonal and of edges, and a predicted stride."""
    codes, decode = kind
    net, generator = Next(codes[:-N_TEST], seed), torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(net.parameters(), rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in tqdm(range(steps), desc="training", disable=None):
        who = torch.randint(len(x) - N_TEST, (BATCH, 1), generator=generator)
        first = torch.randint(N_FRAMES, (BATCH,), generator=generator)
        told, frames = net(codes[who, torch.stack([first, (first + 1) % N_FRAMES], 1)], first, AHEAD)
        loss = (decode(told, frames) - x[who, frames]).square().sum(-1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        codes, x, every = codes[-N_TEST:], x[-N_TEST:], torch.arange(N_FRAMES).expand(N_TEST, -1)
        stride, truth = decode(*net(codes[:, :2], every[:, 0], N_FRAMES - 2)), x[:, 2:]
        edges = edge_lengths(stride, faces) / edge_lengths(truth, faces) - 1
        errors = {"reconstruction": (decode(codes, every) - x).norm(dim=-1), "stride": (stride - truth).norm(dim=-1)}
        return {name: 100 * float(e.abs().mean()) for name, e in (errors | {"edges": edges}).items()}, stride[0]


def main(n_animals: int = 4, steps: int = 300, seed: int = 0, n_modes: int = 30, out: str = "") -> dict[str, tuple]:
    """Errors and the first predicted stride, in each kind of coordinates; these are drawn to a file."""
    x, faces = map(torch.from_numpy, strides(n_animals + N_TEST, N_FRAMES, 0.04, 0.7, 1.2, seed))
    found = {}
    for name, kind in spaces(x, faces, n_animals, n_modes).items():
        found[name] = learn(x, faces, kind, steps, RATES.get(name, 5e-3), seed)
    if out:
        shown = torch.linspace(0, N_FRAMES - 3, 5).long()
        rows = {"truth": x[-N_TEST, 2:][shown], **{name: stride[shown] for name, (_, stride) in found.items()}}
        style = {"titles": [f"step {step + 1}" for step in shown], "view": (0.0, 8.0), "up": "y"}
        errors = {name: 100 * (y - rows["truth"]).norm(dim=-1) for name, y in rows.items()}
        label = "error in % of the bounding box"
        tm.render_sequence(rows, faces, out, colors=errors, color_label=label, keyframe_indices=[], **style)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("--animals", 4), ("--steps", 300), ("--seed", 0)):
        parser.add_argument(name, type=int, default=default)
    parser.add_argument("--out", default="", metavar="FILE")
    given = parser.parse_args()
    for name, (errors, _) in main(given.animals, given.steps, given.seed, out=given.out).items():
        print(f"{name}: " + ", ".join(f"{key} {error:.2f} %" for key, error in errors.items()))
