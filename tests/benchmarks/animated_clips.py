"""Clips of public bodies, of which every eighth frame is given: any method against the frames between.

    python tests/benchmarks/animated_clips.py [--bodies fox frog] [--step 8] [--methods linear smooth]
    python tests/benchmarks/animated_clips.py --pictures FOLDER
    python tests/benchmarks/animated_clips.py --method my_module:my_function [--peer-python FILE]
    python tests/benchmarks/animated_clips.py --export clips; python tests/benchmarks/animated_clips.py --results mine
    python tests/benchmarks/animated_clips.py --sequences coma/bareteeth dfaust/registrations_f.hdf5:NAME ...

Bodies are the animals beside the repository (CC0) and the samples of the package. A method is a function of key-frames
``(K, V, 3)``, faces ``(F, 3)``, the times of the key-frames and other times that gives shapes ``(T, V, 3)``: any of
yours by ``--method``. Or, for methods in other languages, ``--export`` writes ``body-clip.npz`` with ``keyframes``,
``faces``, ``times`` and ``wanted``, and ``--results`` reads ``body-clip.npy`` with the shapes at the times wanted. With
a Python that has it, morphomatics joins, pair by pair.

A sequence of your own is a folder of meshes of one connectivity, PLY or OBJ, in the order of their names: the
registrations of COMA, FAUST (``tr_reg_*.ply``, a sequence of poses), SMAL and TOSCA as they come; or DFAUST's file of
registrations, with the name of one of its sequences or for all (``pip install h5py``). None is shipped.

Means over the frames that are not given, of means over clips: error of edges, relative; of dihedral angles, in degrees,
by edge length; distance to the truth, in percent of the diagonal; volume over the truth's; hinges that are more than a
right angle from the truth's, of a thousand.
"""

import argparse
import importlib
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from cases import DATA, Case, KeyframeSet, animal
from methods import UnavailableError, add_peer, by_peer, peer_python
from results import Table, add_keep
from timing import limit_threads
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.elastic.bend import wrap_angle

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


def ours(smooth: bool, **options: Any) -> Method:
    """A path of this package: a spline, or in-betweens of each pair."""

    def shapes(keyframes: Tensor, faces: Tensor, when: Tensor, times: Tensor) -> Tensor:
        known = keyframes if smooth else tm.extract_bases(keyframes, faces, N_MODES, progress=False)
        return tm.Path(known, faces, when, False, smooth, **options)(keyframes, times)

    return shapes


def morphomatics(keyframes: Tensor, faces: Tensor, when: Tensor, times: Tensor) -> Tensor:
    """Each pair of key-frames by differential coordinates, in a process of its own; linear where that gives nothing."""
    both, found = KeyframeSet(keyframes, faces), []
    for i, (start, end) in enumerate(pairwise(when.tolist())):
        inside = tuple((t - start) / (end - start) for t in times.tolist() if start < t < end)
        try:
            found.append(by_peer(Case("", both, i, i + 1, {}, inside), limit=60).frames)
        except UnavailableError as error:
            print(f"morphomatics: {error}", flush=True)
            wanted = torch.tensor(inside, dtype=when.dtype) * (end - start) + start
            found.append(linear(keyframes, faces, when, wanted))
    return torch.cat(found)


METHODS: dict[str, Method] = {
    "linear": linear,
    "local rotations alone": ours(False, preset="fast", solver=tm.Solver(max_steps=0, local_steps=0)),
    "separate pairs": ours(False),
    "smooth": ours(True),
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

    def of(self, x: Tensor) -> dict[str, float]:
        """By name. *Shape:* ``(T, V, 3)``."""
        own, true = self.shell.measure(x), self.true
        turned = wrap_angle(own.angle - true.angle).abs()
        part = self.shell.energy.parts[1]
        hinges = self.shell._rows(self.truth)[..., part.corners[1]] - self.shell._rows(self.truth)[..., part.corners[0]]
        weights = hinges.norm(dim=0)
        return {
            "edges, %": 100 * float(((own.length - true.length).abs() / true.length).mean()),
            "dihedral angles, deg": float(torch.rad2deg((turned * weights).sum() / weights.sum())),
            "distance, %": 100 * float((x - self.truth).norm(dim=-1).mean() / self.diagonal),
            "volume": float((own.volume / true.volume).mean()),
            "folds, of 1,000": 1000 * float((turned > torch.pi / 2).double().mean()),
        }


def export(folder: Path, given: Iterable[Clip]) -> None:
    """What methods may see of clips."""
    folder.mkdir(parents=True, exist_ok=True)
    for clip in given:
        seen = {"keyframes": clip.frames[clip.given], "faces": clip.faces, "times": clip.given, "wanted": clip.others}
        np.savez(folder / f"{clip.label}.npz", **{name: value.numpy() for name, value in seen.items()})


def draw(folder: Path, ranked: list[tuple[float, Clip, dict[str, Tensor]]]) -> None:
    """The clips with the least and the largest edge error of the last of our methods over the first's."""
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
        )
        print(f"{label}: {clip.body} {clip.name}")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    there = ("fox", "trex", "velociraptor", "frog") if DATA.is_dir() else ()
    parser.add_argument("--bodies", nargs="*", default=list(there), help=f"of {', '.join(BODIES)}")
    parser.add_argument("--sequences", nargs="*", type=Path, default=[], help="folders of meshes, each a clip")
    parser.add_argument("--step", type=int, default=8, help="every so many frames are given")
    parser.add_argument("--methods", nargs="*", default=list(METHODS), help=f"of {', '.join(METHODS)}")
    parser.add_argument("--method", action="append", default=[], metavar="MODULE:FUNCTION", help="one of yours")
    parser.add_argument("--results", type=Path, action="append", default=[], metavar="FOLDER", help="shapes of yours")
    parser.add_argument("--export", type=Path, metavar="FOLDER", help="write what is given of each clip, and stop")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw the best and the worst clip")
    add_peer(parser)
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    warnings.simplefilter("ignore")  # what did not converge is in the table
    methods = {name: METHODS[name] for name in given.methods}
    if peer_python() and given.methods == list(METHODS):
        methods["morphomatics"] = morphomatics
    for name in given.method:
        module, _, function = name.partition(":")
        methods[name] = getattr(importlib.import_module(module), function)
    if given.export:
        export(given.export, clips(given.bodies, given.sequences, given.step))
        return
    rows: dict[str, dict[str, list[dict[str, float]]]] = defaultdict(lambda: defaultdict(list))
    ranked = []
    for clip in clips(given.bodies, given.sequences, given.step):
        shown = clip.frames[clip.given], clip.faces, clip.given.double(), clip.others.double()
        with torch.no_grad():
            answers = {name: method(*shown) for name, method in methods.items()}
        for folder in given.results:
            answers[folder.name] = torch.from_numpy(np.load(folder / f"{clip.label}.npy")).double()
        measures = Measures(clip)
        found = {name: measures.of(x) for name, x in answers.items()}
        for name, values in found.items():
            rows["animals" if clip.body in BODIES else clip.body][name].append(values)
        first, *_, last = (given.methods or list(found)) * 2
        ranked.append((found[last]["edges, %"] / found[first]["edges, %"], clip, answers))
    columns = list(next(iter(found.values())))
    check = "--bodies --methods linear smooth"
    with Table("animated-clips", ["clips", "method", *columns], given.keep, check=check, labels=2) as table:
        for group, by_method in rows.items():
            for name, every in by_method.items():
                means = (np.mean([values[column] for values in every]) for column in columns)
                table.add(f"{group}, {len(every)}", name, *(f"{mean:.3g}" for mean in means))
    if given.pictures is not None:
        given.pictures.mkdir(parents=True, exist_ok=True)
        draw(given.pictures, sorted(ranked, key=lambda row: row[0]))


if __name__ == "__main__":
    main()
