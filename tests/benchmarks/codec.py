"""A motion as key-frames and amplitudes, beside a plain PCA of its frames.

    python tests/benchmarks/codec.py [creature hand-path grip]

Distances are means over the vertices and frames, in 1e-3 of the diagonal; edge errors are means of
``|l - l_true| / l_true``. PCA keeps the mean frame, its components and their coefficients: as many components as fit
into the floats of the encoded motion, which are counted over those of one shape.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import torch
from cases import keyframes_of
from known_motions import OPENED, closed_part, sculpted
from measures import edge_lengths, mean_ratio
from results import Table, add_keep
from timing import limit_threads
from torch import Tensor

import torch_modal as tm

GALLOP, GRIP = 96, 41


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
    choices = tuple(tuple(range(0, GALLOP, GALLOP // n)) for n in (3, 6))
    return Sequence("creature", frames, faces, True, choices)


def hand_path() -> Sequence | None:
    """The rigged hand that closes."""
    found = keyframes_of("mh-hand-path")
    return found and Sequence("mh-hand-path", *found, False, ((0, 4, 8), (0, 2, 4, 6, 8)))


def grip() -> Sequence:
    """A hand that closes, rests, and opens in part."""
    faces, posed = sculpted("hand")
    frames = torch.stack([posed(closed_part(OPENED * i / (GRIP - 1))) for i in range(GRIP)])
    return Sequence("hand with a stop", frames, faces, False, ((0, 13, 27, 40),))


MOTIONS = {"creature": creature, "hand-path": hand_path, "grip": grip}


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


def add(sequence: Sequence, table: Table) -> None:
    """A row for each choice of key-frames."""
    frames = sequence.frames
    for keys in sequence.keyframes:
        encoded = tm.encode(frames, sequence.faces, keys, 60, cyclic=sequence.cyclic, progress=False)
        still = replace(encoded, amplitudes=0 * encoded.amplitudes, motions=0 * encoded.motions)
        by_pca = pca(frames, components(frames, encoded.n_floats))
        found = [sequence.measured(x) for x in (still.decode(), encoded.decode(), by_pca)]
        distances, edges = zip(*found, strict=True)
        cells = [*(f"{distance:.3g}" for distance in distances), *(f"{edge:.2g} %" for edge in edges)]
        table.add(sequence.name, str(len(keys)), f"{encoded.n_floats / frames[0].numel():.2f}", *cells)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motions", nargs="*", help=f"of {', '.join(MOTIONS)}; default: all")
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    ways = "path alone", "with amplitudes", "PCA"
    columns = ["motion", "key-frames", "floats", *(f"{what}, {way}" for what in ("distance", "edges") for way in ways)]
    with Table("compression", columns, given.keep, check="grip", labels=2) as table:
        for name in given.motions or MOTIONS:
            if sequence := MOTIONS[name]():
                add(sequence, table)


if __name__ == "__main__":
    main()
