"""Bits against errors: small files of motions, and what people would use instead.

    python tests/benchmarks/rates.py [creature grip hand-path] [--errors 0.001 0.01] [--picture FILE] [--keep FILE]

All are lossy; each baseline is swept, and its fewest bits at an error come from its lower hull (logarithms in between).

- *ours*: `torch_modal.compress`, 60 amplitudes.
- *PCA*: mean, components times their deviation, and coefficients, rounded; shapes predicted by the parallelogram
  (Touma and Gotsman 1998), and all packed by LZMA.
- *PCA, our coder*: the same shapes and coefficients by the levels and the range coder of `compress`, which is no common
  practice: what is left of the gain is that of key-frames and modes.
- *zstd*: rounded vertices, as differences in time, zstandard at level 19.
- *Draco*: each frame as a mesh by DracoPy, less what it takes at one bit a coordinate, for the faces.
- *meshopt*: what EXT_meshopt_compression stores of a GLB with a morph target a frame, rounded to 16 bits or less, and
  that packed by zstandard (needs `pip install meshopt`).

Bits are of a vertex and frame, without the faces, which all but Draco would keep once. Distances are means over
vertices and frames, over the diagonal; KG is Karni and Gotsman's error in %; edge errors are means of
``|l - l_true| / l_true``; STED is the spatial part of that measure (Vasa and Skala 2011), which is near to
what people see: the deviation of relative edge differences around each vertex, its mean over vertices and frames.
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
from parallelogram import generations, residuals
from threads import limit_threads

import torch_modal as tm
from torch_modal.codec.faces import pack_integers
from torch_modal.codec.hierarchy import VertexHierarchy
from torch_modal.codec.range_coder import IntegerEncoder
from torch_modal.geometry.connectivity import Connectivity

try:
    import meshopt
except ImportError:
    meshopt = None

ERRORS = (0.001, 0.003, 0.01)
COLOURS = {
    "ours": "#d62728",
    "PCA": "#1f77b4",
    "PCA, our coder": "#9ecae1",
    "zstd": "#7f7f7f",
    "Draco": "#2ca02c",
    "meshopt": "#9467bd",
}
Point = dict[str, float]


class Judge:
    """Errors of one motion."""

    def __init__(self, sequence: Sequence) -> None:
        self.sequence, self.frames = sequence, sequence.frames
        self.ends = torch.tensor(Connectivity(sequence.faces.numpy()).edges).T
        self.lengths = self._lengths(self.frames)
        self.degrees = torch.zeros(self.frames.shape[1]).double()
        for end in self.ends:
            self.degrees.index_add_(0, end, torch.ones(len(end)).double())
        centred = self.frames - self.frames.mean((0, 1))
        self.whole = float((centred - centred.mean(1, keepdim=True)).norm())

    def _lengths(self, x: torch.Tensor) -> torch.Tensor:
        i, j = self.ends
        return (x[:, i] - x[:, j]).norm(dim=-1)

    def _sted(self, relative: torch.Tensor) -> float:
        """Spatial part. *Shape:* ``(T, E)``."""
        sums = torch.zeros(2, len(relative), len(self.degrees)).double()
        for end in self.ends:
            sums[0].index_add_(1, end, relative)
            sums[1].index_add_(1, end, relative.square())
        mean, squares = sums / self.degrees.clamp_min(1)
        return float((squares - mean.square()).clamp_min(0).sqrt()[:, self.degrees > 0].mean())

    def point(self, x: torch.Tensor, n_bytes: float) -> Point:
        """What is drawn."""
        apart = x - self.frames
        relative = (self._lengths(x) - self.lengths) / self.lengths
        return {
            "bits": 8 * n_bytes / (self.frames.shape[0] * self.frames.shape[1]),
            "distance": float(apart.norm(dim=-1).mean()) / self.sequence.diagonal,
            "kg": 100 * float(apart.norm()) / self.whole,
            "edges": float(relative.abs().mean()),
            "sted": self._sted(relative),
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
    plan = generations(judge.sequence.faces.numpy(), judge.frames.shape[1])
    for mean, shapes, u, level in components(judge):
        step = level * judge.sequence.diagonal
        every = np.concatenate([mean[None], shapes])
        grid = np.rint(every / step).astype(np.int64).reshape(len(every), -1, 3)
        fine = step / max(np.abs(shapes).max(), 1e-12)
        coefficients = np.rint(u / fine).astype(np.int64)
        left = np.stack([residuals(x, plan).T for x in grid])
        smaller = min((left, grid.transpose(0, 2, 1)), key=lambda part: len(pack_integers(part)))
        series = min(
            (coefficients, np.diff(coefficients, axis=0, prepend=0)), key=lambda part: len(pack_integers(part.T))
        )
        rounded = step * grid.reshape(len(every), -1)
        x = torch.from_numpy((rounded[0] + (fine * coefficients) @ rounded[1:]).reshape(judge.frames.shape))
        yield judge.point(x, len(pack_integers(smaller)) + len(pack_integers(series.T)))


def pca_by_levels(judge: Judge) -> Iterator[Point]:
    """The same, of smooth shapes."""
    hierarchy = VertexHierarchy(judge.sequence.faces.numpy(), judge.frames.shape[1])
    sizes = np.concatenate([np.full(3 * len(level.vertices), i) for i, level in enumerate(hierarchy.levels)])
    for mean, shapes, u, level in components(judge, factor=2):
        step = level * judge.sequence.diagonal
        every = np.concatenate([mean[None], shapes]).reshape(len(shapes) + 1, -1, 3)
        rounded = [hierarchy.encode(x, step, None) for x in every]
        fine = 0.3 * step / max(np.abs(shapes).max(), 1e-12)
        coefficients = np.rint(u / fine).astype(np.int64)
        series = min(
            (coefficients, np.diff(coefficients, axis=0, prepend=0)), key=lambda part: np.log2(1 + np.abs(part)).sum()
        )
        encoder, n = IntegerEncoder(), len(hierarchy.levels)
        flat = np.concatenate([part.reshape(-1) for numbers, _ in rounded for part in numbers])
        encoder.write(flat, np.concatenate([sizes, np.tile(sizes + n, len(shapes))]), 2 * n)
        encoder.write(series.T.reshape(-1), np.repeat(np.arange(len(shapes)), len(u)), len(shapes))
        first, *rest = (x.reshape(-1) for _, x in rounded)
        x = torch.from_numpy((first + (fine * coefficients) @ np.stack(rest)).reshape(judge.frames.shape))
        yield judge.point(x, len(encoder.data()))


def components(judge: Judge, factor: float = 1) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, float]]:
    """Mean, components of the size of their motion, coefficients of at most one, and steps over the diagonal."""
    flat = judge.frames.flatten(1).numpy()
    mean = flat.mean(0)
    u, s, vh = np.linalg.svd(flat - mean, full_matrices=False)
    for n in (1, 2, 3, 4, 5, 6, 8, 10, 14, 20):
        if n >= len(flat) or s[n - 1] < 1e-6 * s[0]:
            break
        largest = np.abs(u[:, :n]).max(0)
        for level in (2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2):
            yield mean, (s[:n] * largest)[:, None] * vh[:n], u[:, :n] / largest, factor * level


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


def by_meshopt(judge: Judge) -> Iterator[Point]:
    """Bits of a coordinate."""
    frames = judge.frames.numpy()
    low, width = frames.min((0, 1)), float((frames.max((0, 1)) - frames.min((0, 1))).max())
    for bits in (6, 7, 8, 9, 10, 11, 12):
        step = width / (2**bits - 1)
        grid = np.rint((frames - low) / step).astype(np.int16)
        targets = np.concatenate([grid[:1], grid[1:] - grid[:1]])
        rows = np.concatenate([targets, np.zeros_like(targets[..., :1])], 2)
        packed = b"".join(meshopt.encode_gltf_buffer(np.ascontiguousarray(each), "ATTRIBUTES") for each in rows)
        yield judge.point(torch.from_numpy(low + step * grid), len(zstandard.compress(packed, 19)))


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

    measures = {
        "distance": "mean distance, % of the diagonal",
        "kg": "KG error, %",
        "edges": "edge error, %",
        "sted": "STED, %",
    }
    figure, axes = plt.subplots(len(found), 4, figsize=(14, 3 * len(found)), squeeze=False, constrained_layout=True)
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
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    figure.savefig(out, dpi=70)


def print_table(found: dict[str, dict[str, list[Point]]]) -> None:
    """Bits of others over ours at the same distance, and edge errors at the same bits."""
    names = [name for name in COLOURS if name != "ours" and all(name in methods for methods in found.values())]
    print(
        f"| motion | mean distance, % | key-frames | ours, bits | {' | '.join(names)} "
        "| edges at these bits, ours / PCA / PCA, our coder, % | STED | s |"
    )
    print("|---" * (len(names) + 7) + "|")
    ratios: dict[str, list[float]] = {name: [] for name in names}
    for motion, methods in found.items():
        for point in methods["ours"]:
            cells = []
            for name in names:
                ratios[name].append(bits_at(methods[name], point["distance"]) / point["bits"])
                cells.append(f"{ratios[name][-1]:.3g}")
            print(
                f"| {motion} | {100 * point['distance']:.3g} | {point['key-frames']:.0f} | {point['bits']:.3g} "
                f"| {' | '.join(cells)} | {_beside(methods, point, 'edges')} | {_beside(methods, point, 'sted')} "
                f"| {point['s']:.0f} |"
            )
    print("\nbits over ours, geometric mean, where there are any:")
    for name, some in ratios.items():
        finite = [ratio for ratio in some if math.isfinite(ratio)]
        print(f"{name:16s} {math.exp(np.mean(np.log(finite))):.2f} ({len(finite)} of {len(some)})")


def _beside(methods: dict[str, list[Point]], point: Point, measure: str) -> str:
    """A measure of ours, and the least that others have at the same bits, in %."""
    cells = [f"{100 * point[measure]:.2g}"]
    for name in ("PCA", "PCA, our coder"):
        least = min((p[measure] for p in methods[name] if p["bits"] <= point["bits"]), default=math.nan)
        cells.append(f"{100 * least:.2g}")
    return " / ".join(cells)


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
        methods = {"PCA": pca, "PCA, our coder": pca_by_levels, "zstd": zstd, "Draco": draco}
        if meshopt is not None:
            methods["meshopt"] = by_meshopt
        found[sequence.name] = {
            "ours": list(ours(judge, args.errors)),
            **{method: list(points(judge)) for method, points in methods.items()},
        }
        if args.keep:
            args.keep.write_text(json.dumps(found, indent=0))
    print_table(found)
    if args.picture:
        draw(found, args.picture)


if __name__ == "__main__":
    main()
