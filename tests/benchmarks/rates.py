"""Bits against errors: small files of motions, and what people would use instead.

    python tests/benchmarks/rates.py [creature grip hand-path] [--errors 0.001 0.01] [--picture FILE] [--keep FILE]

All are lossy; each baseline is swept, and its fewest bits at an error come from its lower hull (logarithms in between).

- *ours*: `torch_modal.compress`, 60 amplitudes.
- *PCA*: mean, components times their deviation, and coefficients, rounded, with the vertex prediction and the packing
  of `compress`: better than common practice.
- *zstd*: rounded vertices, as differences in time, zstandard at level 19.
- *Draco*: each frame as a mesh by DracoPy, less what it takes at one bit a coordinate, for the faces.

Bits are of a vertex and frame, without the faces, which all but Draco would keep once. Distances are means over
vertices and frames, over the diagonal; KG is Karni and Gotsman's error in %; edge errors are means of
``|l - l_true| / l_true``.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import DracoPy
import numpy as np
import torch
import zstandard
from codec import MOTIONS, Sequence
from threads import limit_threads

import torch_modal as tm
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.sequence.codec_packing import squeeze
from torch_modal.sequence.codec_prediction import generations, residuals

ERRORS = (0.001, 0.003, 0.01)
COLOURS = {"ours": "#d62728", "PCA": "#1f77b4", "zstd": "#7f7f7f", "Draco": "#2ca02c"}
Point = dict[str, float]


class Judge:
    """Errors of one motion."""

    def __init__(self, sequence: Sequence) -> None:
        self.sequence, self.frames = sequence, sequence.frames
        self.ends = torch.tensor(Connectivity(sequence.faces.numpy()).edges).T
        self.lengths = self._lengths(self.frames)
        centred = self.frames - self.frames.mean((0, 1))
        self.whole = float((centred - centred.mean(1, keepdim=True)).norm())

    def _lengths(self, x: torch.Tensor) -> torch.Tensor:
        i, j = self.ends
        return (x[:, i] - x[:, j]).norm(dim=-1)

    def point(self, x: torch.Tensor, n_bytes: float) -> Point:
        """What is drawn."""
        apart = x - self.frames
        return {
            "bits": 8 * n_bytes / (self.frames.shape[0] * self.frames.shape[1]),
            "distance": float(apart.norm(dim=-1).mean()) / self.sequence.diagonal,
            "kg": 100 * float(apart.norm()) / self.whole,
            "edges": float(((self._lengths(x) - self.lengths).abs() / self.lengths).mean()),
        }


def ours(judge: Judge, errors: list[float]) -> Iterator[Point]:
    """Files of promised errors."""
    sequence = judge.sequence
    with tempfile.TemporaryDirectory() as folder:
        for error in errors:
            start, path = time.process_time(), Path(folder) / "a.tms"
            done = tm.compress(sequence.frames, sequence.faces, path, error, cyclic=sequence.cyclic, progress=False)
            point = judge.point(tm.ModalSequence.load(path).decode(), done.n_bytes - done.n_faces_bytes)
            yield {**point, "asked": error, "key-frames": len(done.keyframes), "s": time.process_time() - start}


def pca(judge: Judge) -> Iterator[Point]:
    """Numbers of components, and steps."""
    frames = judge.frames
    t, v = frames.shape[:2]
    plan = generations(judge.sequence.faces.numpy().astype(np.int64), v)
    flat = frames.flatten(1).numpy()
    mean = flat.mean(0)
    u, s, vh = np.linalg.svd(flat - mean, full_matrices=False)
    for n in sorted({*range(1, min(t, 9)), *range(10, min(t, 25), 3)}):
        for level in (2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2):
            step = level * judge.sequence.diagonal
            # A coefficient is at most of the order of one; a component has the size of its motion.
            sizes = np.abs(u[:, :n]).max(0)
            shapes = np.concatenate([mean[None], (s[:n] * sizes)[:, None] * vh[:n]])
            grid = np.rint(shapes / step).astype(np.int64).reshape(-1, v, 3)
            fine = step / max(np.abs(shapes[1:]).max(), 1e-12)
            coefficients = np.rint(u[:, :n] / sizes / fine).astype(np.int64)
            left = np.stack([residuals(x, plan, "parallelogram", None).T for x in grid])
            smaller = min((left, grid.transpose(0, 2, 1)), key=lambda part: len(squeeze(part)))
            series = min(
                (coefficients, np.diff(coefficients, axis=0, prepend=0)), key=lambda part: len(squeeze(part.T))
            )
            rounded = step * grid.reshape(n + 1, -1)
            x = torch.from_numpy((rounded[0] + (fine * coefficients) @ rounded[1:]).reshape(frames.shape))
            yield judge.point(x, len(squeeze(smaller)) + len(squeeze(series.T)))


def zstd(judge: Judge) -> Iterator[Point]:
    """Steps."""
    frames = judge.frames.numpy()
    for level in (5e-4, 1e-3, 2e-3, 4e-3, 8e-3, 1.6e-2, 3.2e-2):
        step = level * judge.sequence.diagonal
        grid = np.rint(frames / step).astype(np.int64)
        data = np.diff(grid, axis=0, prepend=0).astype(np.int16).transpose(2, 0, 1)
        yield judge.point(torch.from_numpy(step * grid), len(zstandard.compress(np.ascontiguousarray(data), 19)))


def draco(judge: Judge) -> Iterator[Point]:
    """Bits of a coordinate."""
    faces = judge.sequence.faces.numpy().astype(np.uint32)
    for bits in (6, 7, 8, 9, 10, 11, 12):
        total, found = 0.0, []
        for x in judge.frames.numpy():
            data = DracoPy.encode(x.astype(np.float32), faces, quantization_bits=bits, compression_level=10)
            nothing = DracoPy.encode(x.astype(np.float32), faces, quantization_bits=1, compression_level=10)
            total += len(data) - len(nothing)
            low, width = x.min(0), float((x.max(0) - x.min(0)).max())
            step = width / (2**bits - 1)  # its order of vertices is another: the same rounding in ours
            found.append(low + step * np.rint((x - low) / step))
        yield judge.point(torch.from_numpy(np.stack(found)), total)


def bits_at(points: list[Point], error: float, measure: str = "distance") -> float:
    """The fewest bits for an error, between the points of a lower hull; infinite beyond the smallest error."""
    best: list[Point] = []
    for point in sorted(points, key=lambda each: each["bits"]):
        if not best or point[measure] < best[-1][measure]:
            best.append(point)
    for one, other in zip([None, *best[:-1]], best, strict=True):
        if other[measure] <= error:
            if one is None:
                return other["bits"]
            part = math.log(error / one[measure]) / math.log(other[measure] / one[measure])
            return math.exp((1 - part) * math.log(one["bits"]) + part * math.log(other["bits"]))
    return math.inf


def draw(found: dict[str, dict[str, list[Point]]], out: Path) -> None:
    """Curves of all motions."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter

    measures = {"distance": "mean distance, % of the diagonal", "kg": "KG error, %", "edges": "edge error, %"}
    figure, axes = plt.subplots(len(found), 3, figsize=(11, 3 * len(found)), squeeze=False, constrained_layout=True)
    for row, (name, methods) in zip(axes, found.items(), strict=True):
        for axis, (measure, label) in zip(row, measures.items(), strict=True):
            for method, points in methods.items():
                best: list[Point] = []
                for point in sorted(points, key=lambda each: each["bits"]):
                    if not best or point[measure] < best[-1][measure]:
                        best.append(point)
                scale = 1 if measure == "kg" else 100
                axis.plot(
                    [p["bits"] for p in best],
                    [scale * p[measure] for p in best],
                    "o-",
                    ms=3,
                    color=COLOURS[method],
                    label=method,
                )
            axis.set(xscale="log", yscale="log", xlabel="bits a vertex and frame", ylabel=label, title=name)
            axis.grid(alpha=0.3)
            axis.xaxis.set_minor_formatter(NullFormatter())
        row[2].legend(fontsize="small")
    figure.savefig(out, dpi=70)


def main() -> None:
    """Print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motions", nargs="*", help=f"of {', '.join(MOTIONS)}; default: all")
    parser.add_argument("--errors", nargs="+", type=float, default=list(ERRORS))
    parser.add_argument("--picture", type=Path, metavar="FILE")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="points of earlier runs, and of this one")
    args = parser.parse_args()
    limit_threads()
    found = json.loads(args.keep.read_text()) if args.keep and args.keep.exists() else {}
    for name in args.motions or MOTIONS:
        sequence = MOTIONS[name]()
        if sequence is None or sequence.name in found:
            continue
        judge = Judge(sequence)
        methods = {"PCA": pca, "zstd": zstd, "Draco": draco}
        found[sequence.name] = {
            "ours": list(ours(judge, args.errors)),
            **{method: list(points(judge)) for method, points in methods.items()},
        }
        if args.keep:
            args.keep.write_text(json.dumps(found, indent=0))
    print(
        "| motion | mean distance, % | key-frames | ours, bits | PCA over ours | zstd | Draco | edges, ours / PCA, % |"
    )
    print("|---" * 8 + "|")
    ratios = []
    for name, methods in found.items():
        for point in methods["ours"]:
            others = [bits_at(methods[m], point["distance"]) / point["bits"] for m in ("PCA", "zstd", "Draco")]
            ratios.append(min(others))
            near = [p for p in methods["PCA"] if p["distance"] <= point["distance"]]
            edges = min(near, key=lambda p: p["bits"])["edges"] if near else math.nan
            print(
                f"| {name} | {100 * point['distance']:.3g} | {point['key-frames']:.0f} | {point['bits']:.3g} | "
                f"{' | '.join(f'{x:.3g}' for x in others)} | {100 * point['edges']:.2g} / {100 * edges:.2g} |"
            )
    print(f"\nthe best baseline over ours, geometric mean: {math.exp(np.mean(np.log(ratios))):.2f}")
    if args.picture:
        draw(found, args.picture)


if __name__ == "__main__":
    main()
