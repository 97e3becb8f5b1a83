"""Clips of public bodies, of which every eighth frame is given: any method against the frames between.

    python tests/benchmarks/public.py [--bodies fox] [--step 8] [--methods linear smooth] [--pictures FOLDER]
    python tests/benchmarks/public.py --method my_module:my_function [--peer-python FILE]
    python tests/benchmarks/public.py --export clips; python tests/benchmarks/public.py --results mine
    python tests/benchmarks/public.py --sequences coma/bareteeth dfaust/registrations_f.hdf5:50004_jumping_jacks ...

Bodies are the animals beside the repository (CC0) and the samples of the package. A method is a function of key-frames
``(K, V, 3)``, faces ``(F, 3)``, the times of the key-frames and other times that gives shapes ``(T, V, 3)``: any of
yours by ``--method``. Or, for methods in other languages, ``--export`` writes ``body-clip.npz`` with ``keyframes``,
``faces``, ``times`` and ``wanted``, and ``--results`` reads ``body-clip.npy`` with the shapes at the times wanted. With
a Python that has it, morphomatics joins, pair by pair.

A sequence of your own is a folder of meshes of one connectivity, PLY or OBJ, in the order of their names: the
registrations of COMA, FAUST (``tr_reg_*.ply``, a sequence of poses), SMAL and TOSCA as they come; or DFAUST's file of
registrations, with the name of one of its sequences or for all (``pip install h5py``). None is shipped.

Means over the frames that are not given: error of edges, relative; of dihedral angles, in degrees, by edge length;
distance to the truth, in percent of the diagonal; angle of normals, in degrees; conformal distortion of triangles
against the truth, the median of ``(s1/s2 + s2/s1) / 2 - 1``; volume over the truth's; standard deviation of the area
along the clip over its mean, with that of the truth beside it; hinges that are more than a right angle from the
truth's, of a thousand; pairs of triangles that intersect, in each shape, with those of the truth beside it (extra
``contact``); milliseconds of one core for each shape, without what is prepared beforehand. Rows are means
over clips.
"""

import argparse
import importlib
import os
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from cases import DATA, Case, KeyframeSet, animal
from methods import Outcome, UnavailableError, by_peer, peer_python
from scipy.interpolate import CubicHermiteSpline
from tables import head
from timing import limit_threads
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.energy.bend import wrap_angle

BODIES = ("fox", "husky", "cow", "trex", "velociraptor", "frog")
N_MODES = 30

Method = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]


class Clip(NamedTuple):
    """A motion, of which some frames are given."""

    body: str
    name: str
    frames: Tensor
    """*Shape:* ``(T, V, 3)``."""
    faces: Tensor
    """*Shape:* ``(F, 3)``."""
    given: Tensor
    """Numbers of the frames that are given, the first and the last among them. *Shape:* ``(K,)``."""

    @property
    def label(self) -> str:
        """Name of its files."""
        return f"{self.body}-{self.name}".replace("/", "_").replace(" ", "_")

    @property
    def others(self) -> Tensor:
        """Numbers of the others."""
        return torch.tensor([i for i in range(len(self.frames)) if i not in set(self.given.tolist())])


def clips(bodies: list[str], sequences: list[Path], step: int) -> Iterator[Clip]:
    """All of them, cut after the last frame that is given."""
    for body in bodies:
        frames, faces, parts = animal(body)
        for name, start, end in parts:
            yield from cut(body, name, frames[start:end], faces, step)
    for sequence in sequences:
        if sequence.is_dir():
            files = sorted(file for file in sequence.iterdir() if file.suffix.lower() in (".ply", ".obj"))
            yield from cut(sequence.name, "", *tm.load_keyframes(files), step)
        else:
            yield from dfaust(sequence, step)
    for name in ("creature", "hand") if not sequences else ():
        sample = load_sample(name)
        n = len(sample.truth)
        count = min(n + 1, len(sample.keyframes))
        if name == "creature":  # a cycle: its last key-frame leads on to the first
            both = torch.stack([sample.keyframes, sample.truth], 1).flatten(0, 1)
            yield Clip("samples", name, torch.cat([both, both[:1]]), sample.faces, torch.arange(0, 2 * count + 1, 2))
        else:
            frames = torch.cat([sample.keyframes[:1], sample.truth, sample.keyframes[1:]])
            yield Clip("samples", name, frames, sample.faces, torch.tensor([0, n + 1]))


def dfaust(given: Path, step: int) -> Iterator[Clip]:
    """One sequence, ``file.hdf5:name``, or all of a file: arrays ``(V, 3, T)`` by name, and ``faces``."""
    import h5py

    file, _, only = str(given).partition(":")
    with h5py.File(file) as stored:
        faces = torch.tensor(np.array(stored["faces"])).long()
        names = sorted(name for name in stored if name != "faces")
        if only and only not in names:
            raise SystemExit(f"{file} has no sequence {only!r}; it has {', '.join(names)}")
        for name in [only] if only else names:
            frames = torch.tensor(np.array(stored[name])).double().movedim(-1, 0)
            yield from cut(Path(file).stem, name, frames, faces, step)


def cut(body: str, name: str, frames: Tensor, faces: Tensor, step: int) -> Iterator[Clip]:
    """Every so many frames are given."""
    given = torch.arange(0, len(frames), step)
    if len(given) > 1:
        yield Clip(body, name, frames[: int(given[-1]) + 1], faces, given)


# ------------------------------------------------------------------------------------------------------------- methods
def linear(keyframes: Tensor, faces: Tensor, when: Tensor, times: Tensor) -> Tensor:
    """Each vertex on a straight line."""
    i = (torch.searchsorted(when, times, right=True) - 1).clamp(0, len(when) - 2)
    return torch.lerp(keyframes[i], keyframes[i + 1], ((times - when[i]) / when.diff()[i])[:, None, None])


def catmull_rom(keyframes: Tensor, faces: Tensor, when: Tensor, times: Tensor) -> Tensor:
    """Each vertex on a cubic, with velocities from both neighbours."""
    before, after = torch.arange(len(when)) - 1, torch.arange(len(when)) + 1
    before, after = before.clamp(min=0), after.clamp(max=len(when) - 1)
    velocities = (keyframes[after] - keyframes[before]) / (when[after] - when[before])[:, None, None]
    return torch.from_numpy(CubicHermiteSpline(when.numpy(), keyframes.numpy(), velocities.numpy())(times.numpy()))


class Ours:
    """A way through the key-frames; bases and tables are made once."""

    def __init__(self, smooth: bool, preset: str, solver: tm.Solver | None = None) -> None:
        self.smooth, self.preset, self.solver = smooth, preset, solver
        self._path: tuple[Tensor, tm.Path] | None = None

    def __call__(self, keyframes: Tensor, faces: Tensor, when: Tensor, times: Tensor) -> Tensor:
        """As the others."""
        if self._path is None or self._path[0] is not keyframes:
            bases = tm.extract_bases(keyframes, faces, N_MODES, progress=False)
            path = tm.Path(bases, faces, when, False, self.smooth, self.preset, solver=self.solver)  # type: ignore[arg-type]
            self._path = keyframes, path
        return self._path[1](keyframes, times)


class Morphomatics:
    """Each pair of key-frames by differential coordinates, in a process of its own; linear where that gives nothing."""

    def __init__(self) -> None:
        self.seconds = 0.0
        """Of the last call, by the clocks of its processes, without what they prepare."""

    def __call__(self, keyframes: Tensor, faces: Tensor, when: Tensor, times: Tensor) -> Tensor:
        """As the others."""
        both, found = KeyframeSet(keyframes, faces), []
        for i, (start, end) in enumerate(pairwise(when.tolist())):
            inside = tuple((t - start) / (end - start) for t in times.tolist() if start < t < end)
            try:
                outcome = by_peer(Case("", both, i, i + 1, {}, inside), limit=60)
            except UnavailableError as error:
                print(f"morphomatics: {error}", flush=True)
                wanted = torch.tensor(inside, dtype=when.dtype) * (end - start) + start
                outcome = Outcome(linear(keyframes, faces, when, wanted), 0.0)
            found.append(outcome)
        self.seconds = sum(outcome.seconds for outcome in found)
        return torch.cat([outcome.frames for outcome in found])


METHODS: dict[str, Method] = {
    "linear": linear,
    "Catmull-Rom": catmull_rom,
    "ARAP-blend": Ours(False, "fast", tm.Solver(max_steps=0, local_steps=0)),
    "pair": Ours(False, "accurate"),
    "fast": Ours(True, "fast"),
    "smooth": Ours(True, "accurate"),
}


# ------------------------------------------------------------------------------------------------------------ measures
class Measures:
    """What is measured on the shapes of a clip."""

    def __init__(self, clip: Clip) -> None:
        self.faces, self.truth = clip.faces, clip.frames[clip.others]
        self.shell = tm.ShellEnergy(clip.faces)
        first = clip.frames[0]
        self.diagonal = (first.amax(0) - first.amin(0)).norm()
        self.true = self.shell.measure(self.truth)
        self.crossings = self._crossings(self.truth)

    def of(self, x: Tensor) -> dict[str, float]:
        """By name. *Shape:* ``(T, V, 3)``."""
        own, true = self.shell.measure(x), self.true
        turned = wrap_angle(own.angle - true.angle).abs()
        part = self.shell.energy.parts[1]
        hinges = self.shell._rows(self.truth)[..., part.corners[1]] - self.shell._rows(self.truth)[..., part.corners[0]]
        weights = hinges.norm(dim=0)
        normals, areas = self._normals(x)
        true_normals, true_areas = self._normals(self.truth)
        angles = torch.rad2deg(torch.acos((normals * true_normals).sum(-1).clamp(-1, 1)))
        spread = [float(a.sum(-1).std(correction=0) / a.sum(-1).mean()) for a in (areas, true_areas)]
        return {
            "edges, %": 100 * float(((own.length - true.length).abs() / true.length).mean()),
            "dihedral, deg": float(torch.rad2deg((turned * weights).sum() / weights.sum())),
            "distance, %": 100 * float((x - self.truth).norm(dim=-1).mean() / self.diagonal),
            "normals, deg": float((angles * true_areas).sum() / true_areas.sum()),
            "conformal": float(self._conformal(x)),
            "volume": float((own.volume / true.volume).mean()),
            "area std, %": 100 * spread[0],
            "of truth, %": 100 * spread[1],
            "folds, 1/1000": 1000 * float((turned > torch.pi / 2).double().mean()),
            "crossings": self._crossings(x),
            "truth's": self.crossings,
        }

    def _crossings(self, x: Tensor) -> float:
        """Pairs of triangles that intersect, in the mean of the shapes."""
        try:
            return float(tm.self_contacts(x, self.faces).number.double().mean())
        except ImportError:
            return float("nan")

    def _normals(self, x: Tensor) -> tuple[Tensor, Tensor]:
        a, b, c = (x[:, corner] for corner in self.faces.T)
        normals = torch.linalg.cross(b - a, c - a)
        doubled = normals.norm(dim=-1)
        return normals / doubled.clamp_min(1e-300)[..., None], 0.5 * doubled

    def _conformal(self, x: Tensor) -> Tensor:
        """Median over the triangles: those that are nearly lines have no bound."""

        def gram(y: Tensor) -> Tensor:
            a, b, c = (y[:, corner] for corner in self.faces.T)
            sides = torch.stack([b - a, c - a], -1)
            return sides.mT @ sides

        own, true = gram(x), gram(self.truth)
        # Of the singular values s of the map: trace and determinant of G_true^-1 G are s1^2 + s2^2 and s1^2 s2^2.
        determinants = [(g[..., 0, 0] * g[..., 1, 1] - g[..., 0, 1] ** 2).clamp_min(1e-300) for g in (own, true)]
        trace = (
            own[..., 0, 0] * true[..., 1, 1] + own[..., 1, 1] * true[..., 0, 0] - 2 * own[..., 0, 1] * true[..., 0, 1]
        )
        product = (determinants[0] * determinants[1]).sqrt()
        return (0.5 * trace / product - 1).median()


def answer(clip: Clip, method: Method) -> tuple[Tensor, float]:
    """Shapes of a method, and milliseconds for each."""
    given = clip.frames[clip.given], clip.faces, clip.given.double(), clip.others.double()
    with torch.no_grad():
        if isinstance(method, Morphomatics):
            found, taken = method(*given), method.seconds
        else:
            method(*given)  # what is prepared once
            start = time.process_time()
            found, taken = method(*given), time.process_time() - start
    return found, 1000 * taken / len(found)


def export(folder: Path, given: Iterable[Clip]) -> None:
    """What methods may see of clips."""
    folder.mkdir(parents=True, exist_ok=True)
    for clip in given:
        seen = {"keyframes": clip.frames[clip.given], "faces": clip.faces, "times": clip.given, "wanted": clip.others}
        np.savez(folder / f"{clip.label}.npz", **{name: value.numpy() for name, value in seen.items()})


def table(title: str, rows: dict[str, list[dict[str, float]]]) -> None:
    """Means over clips."""
    names = list(next(iter(rows.values()))[0])
    print(f"\n{head(title, *names)}")
    for method, values in rows.items():
        means = (np.mean([value[name] for value in values]) for name in names)
        print(f"| {method} | {' | '.join(f'{mean:.3g}' for mean in means)} |", flush=True)


def draw(folder: Path, ranked: list[tuple[float, Clip, dict[str, Tensor]]]) -> None:
    """The clips with the least and the largest edge error of the last method, over the first's."""
    for label, (_, clip, found) in (("best", ranked[0]), ("worst", ranked[-1])):
        others = clip.others
        middle = [int((others - n).abs().argmin()) for n in np.linspace(others[0], others[-1], 4)]
        rows = {"truth": clip.frames[others][middle]} | {name: x[middle] for name, x in found.items()}
        tm.render_sequence(
            rows,
            clip.faces,
            folder / f"public-{label}.png",
            titles=[f"frame {int(others[i])}" for i in middle],
            keyframe_indices=[],
            overwrite=True,
        )
        print(f"{label}: {clip.body} {clip.name}")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    there = BODIES if DATA.is_dir() else ()
    parser.add_argument("--bodies", nargs="*", default=list(there), help=f"of {', '.join(BODIES)}")
    parser.add_argument("--sequences", nargs="*", type=Path, default=[], help="folders of meshes, each a clip")
    parser.add_argument("--step", type=int, default=8, help="every so many frames are given")
    parser.add_argument("--methods", nargs="*", default=list(METHODS), help=f"of {', '.join(METHODS)}")
    parser.add_argument("--method", action="append", default=[], metavar="MODULE:FUNCTION", help="one of yours")
    parser.add_argument("--results", type=Path, action="append", default=[], metavar="FOLDER", help="shapes of yours")
    parser.add_argument("--export", type=Path, metavar="FOLDER", help="write what is given of each clip, and stop")
    parser.add_argument("--peer-python", type=Path, metavar="FILE", help="a Python that has morphomatics")
    parser.add_argument("--by-body", action="store_true", help="a table for each body too")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw the best and the worst clip")
    given = parser.parse_args()
    limit_threads()
    warnings.simplefilter("ignore")  # what did not converge is in the table
    methods = {name: METHODS[name] for name in given.methods}
    for name in given.method:
        module, _, function = name.partition(":")
        methods[name] = getattr(importlib.import_module(module), function)
    if given.peer_python:
        os.environ["TORCH_MODAL_PEER_PYTHON"] = str(given.peer_python)
    if peer_python():
        methods["morphomatics"] = Morphomatics()
    if given.export:
        export(given.export, clips(given.bodies, given.sequences, given.step))
        return
    every: dict[str, dict[str, list[dict[str, float]]]] = defaultdict(lambda: defaultdict(list))
    ranked = []
    start = time.perf_counter()
    for clip in clips(given.bodies, given.sequences, given.step):
        answers = {name: answer(clip, method) for name, method in methods.items()}
        for folder in given.results:
            answers[folder.name] = torch.from_numpy(np.load(folder / f"{clip.label}.npy")).double(), float("nan")
        measures = Measures(clip)
        for name, (found, taken) in answers.items():
            row = measures.of(found) | {"ms": taken}
            for group in ("all clips", clip.body):
                every[group][name].append(row)
        errors = [every["all clips"][name][-1]["edges, %"] for name in methods]
        ranked.append((errors[-1] / errors[0], clip, {name: found for name, (found, _) in answers.items()}))
    for group, rows in every.items():
        if group == "all clips" or given.by_body:
            table(f"{group}, {len(next(iter(rows.values())))}", rows)
    if given.pictures is not None:
        given.pictures.mkdir(parents=True, exist_ok=True)
        draw(given.pictures, sorted(ranked, key=lambda row: row[0]))
    print(f"\n{len(ranked)} clips in {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
