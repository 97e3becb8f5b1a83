"""A motion as key-frames and amplitudes, against a plain PCA of its frames.

    python tests/benchmarks/codec.py [floats decode] [--motions creature hand-path grip]
    python tests/benchmarks/codec.py long

Distances are means over the vertices and frames, over the diagonal; edge errors are means of ``|l - l_true| / l_true``.
PCA keeps the mean frame, its components and their coefficients: with as many components as fit into the floats of the
encoded motion, and with one more, which takes more floats. Times are of the processor.
"""

from __future__ import annotations

import argparse
import math
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from cases import divided, keyframes_of
from measures import edge_lengths, mean_ratio
from motions import OPENED, closed_part, sculpted
from tables import head
from timing import limit_threads
from torch import Tensor

import torch_modal as tm

GALLOP, GRIP, LONG = 96, 41, 1000


@dataclass(frozen=True, eq=False)
class Sequence:
    """A motion whose frames are all known."""

    name: str
    frames: Tensor
    faces: Tensor
    cyclic: bool
    keyframes: tuple[tuple[int, ...], ...]
    """Choices of key-frames, evenly spaced."""

    @property
    def diagonal(self) -> float:
        """Of the bounding box of the first frame."""
        return float((self.frames[0].amax(0) - self.frames[0].amin(0)).norm())

    def measured(self, x: Tensor) -> tuple[float, float]:
        """Distance, in 1e-3 of the diagonal, and edge error, in %."""
        lengths = (edge_lengths(y, self.faces) for y in (x, self.frames))
        distance = float((x - self.frames).norm(dim=-1).mean()) / self.diagonal
        return 1e3 * distance, 100 * mean_ratio(*lengths)


def creature() -> Sequence:
    """The sample creature's gallop."""
    faces, posed = sculpted("creature")
    frames = torch.stack([posed(6 * i / GALLOP) for i in range(GALLOP)])
    choices = tuple(tuple(range(0, GALLOP, GALLOP // n)) for n in (3, 4, 6))
    return Sequence("creature", frames, faces, True, choices)


def hand_path() -> Sequence | None:
    """The rigged hand that closes."""
    found = keyframes_of("mh-hand-path")
    return found and Sequence("mh-hand-path", *found, False, ((0, 8), (0, 4, 8), (0, 2, 4, 6, 8)))


def grip() -> Sequence:
    """A hand that closes, rests, and opens in part."""
    faces, posed = sculpted("hand")
    frames = torch.stack([posed(closed_part(OPENED * i / (GRIP - 1))) for i in range(GRIP)])
    return Sequence("hand with a stop", frames, faces, False, ((0, 13, 27, 40), (0, 8, 16, 24, 32, 40)))


MOTIONS = {"creature": creature, "hand-path": hand_path, "grip": grip}


def chosen(names: list[str]) -> Iterator[Sequence]:
    """Those motions that are there."""
    for name in names:
        found = MOTIONS[name]()
        if found is not None:
            yield found


def pca(frames: Tensor, n: int) -> Tensor:
    """Frames from their mean and so many components."""
    flat = frames.flatten(1)
    mean = flat.mean(0)
    u, s, vh = torch.linalg.svd(flat - mean, full_matrices=False)
    return ((u[:, :n] * s[:n]) @ vh[:n] + mean).reshape(frames.shape)


def components(frames: Tensor, n_floats: int) -> int:
    """The most components of PCA with at most so many floats."""
    t, numbers = len(frames), frames[0].numel()
    return min(t, (n_floats - numbers) // (numbers + t))


def print_floats(sequence: Sequence) -> None:
    """Rows of distances at the same floats."""
    frames = sequence.frames
    for keys in sequence.keyframes:
        encoded = tm.encode(frames, sequence.faces, keys, 60, cyclic=sequence.cyclic, progress=False)
        still = replace(encoded, amplitudes=0 * encoded.amplitudes, motions=0 * encoded.motions)
        n = components(frames, encoded.n_floats)
        numbers = frames[0].numel()
        own, path = sequence.measured(encoded.decode()), sequence.measured(still.decode())
        others = [(m, *sequence.measured(pca(frames, m))) for m in (n, n + 1)]
        cells = [f"{m}: {d:.3g}, {e:.2g} = **{own[0] / d:.2f}, {own[1] / e:.2f}**" for m, d, e in others]
        print(
            f"| {sequence.name} | {len(keys)} | {encoded.n_floats / numbers:.2f} | {path[0]:.3g}, {path[1]:.2g} "
            f"| {own[0]:.3g}, {own[1]:.2g} | {cells[0]} | {cells[1]} |",
            flush=True,
        )


def print_decode(sequence: Sequence) -> None:
    """A row of speed: 100 frames of about 8,000 vertices."""
    x, faces = sequence.frames[:2], sequence.faces
    while x.shape[1] < 8000:
        x, faces = divided(x, faces)
    keys = tm.encode(x, faces, [0, 1], 60, progress=False)
    t = torch.linspace(0, 1, 100, dtype=torch.float64)
    a = torch.randn(100, keys.n_modes, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for kind in (torch.float64, torch.float32):
        decoder = keys.decoder.to(kind)
        with torch.no_grad():
            decoder(a[:1].to(kind), t[:1].to(kind))
            start = time.process_time()
            decoder(a.to(kind), t.to(kind))
            seconds = time.process_time() - start
        print(f"| {sequence.name}, {x.shape[1]} vertices, {kind} | {100 / seconds:.0f} frames a second |", flush=True)


def print_long() -> None:
    """A row of 1,000 frames: the creature gallops ten strides, each with another reach, and is not periodic."""
    import train_motion

    faces, posed = train_motion.galloping(0.04)
    reaches = [[1 + 0.15 * math.sin(0.011 * i + part) for part in range(3)] for i in range(LONG)]
    frames = torch.stack([posed(reach, 6 * i / 100) for i, reach in enumerate(reaches)])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()
    found = tm.encode(frames, faces, None, 20, error=0.01, progress=False)
    seconds = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    own = frames.numel() * 8 / 2**20
    columns = "frames", "vertices", "key-frames", "mean distance, worst, %", "seconds", "frames, MB"
    print(head(*columns, "peak before, after, MB"))
    print(
        f"| {LONG} | {frames.shape[1]} | {len(found.keyframes)} | {100 * float(found.errors.mean()):.2g}, "
        f"{100 * float(found.errors.max()):.2g} | {seconds:.0f} | {own:.0f} | {before / 1024:.0f}, {peak / 1024:.0f} |"
    )


FLOATS = ("motion", "key-frames", "floats / 3V", "path: distance, edges", "+ 60 amplitudes")
PCA = ("PCA, components: distance, edges = ours over it", "PCA of more floats")
TABLES = {"floats": ((*FLOATS, *PCA), print_floats), "decode": (("decoding on one core", "speed"), print_decode)}


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", help=f"of {', '.join(TABLES)}, or long; default: all but that")
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=list(MOTIONS))
    args = parser.parse_args()
    limit_threads()
    for name in args.tables or TABLES:
        if name == "long":
            print_long()
            continue
        columns, row = TABLES[name]
        print(head(*columns))
        for sequence in chosen(args.motions):
            row(sequence)


if __name__ == "__main__":
    main()
