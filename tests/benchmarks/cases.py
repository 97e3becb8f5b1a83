"""Pairs of key-frames that the benchmarks run on, what is known to lie between them, and bases for both ends."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

import torch_modal as tm
from torch_modal.data.samples import SAMPLES, load_sample
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.io.read import SUFFIXES

sys.path.append(str(Path(__file__).parents[1]))  # beside the tests
from helpers.bodies import body

DATA = Path(__file__).parents[2].parent / "shared" / "data"
HALF = 0.5


@dataclass(eq=False)
class KeyframeSet:
    """Shapes of one connectivity, whose bases are made together when they are first asked for."""

    keyframes: torch.Tensor
    faces: torch.Tensor
    made: dict[int, list[tm.ModalBasis]] = field(default_factory=dict)

    def bases(self, n_modes: int) -> list[tm.ModalBasis]:
        """Of all shapes, in their order."""
        if n_modes not in self.made:
            self.made[n_modes] = tm.extract_bases(self.keyframes, self.faces, n_modes)
        return self.made[n_modes]


@dataclass(frozen=True, eq=False)
class Case:
    """Two key-frames, and the times between them at which shapes are wanted."""

    name: str
    shapes: KeyframeSet
    first: int
    last: int
    truths: dict[float, torch.Tensor]
    """The true in-betweens that are known, by their time. *Shape of each:* ``(V, 3)``."""
    times: tuple[float, ...] = (HALF,)

    @property
    def x_a(self) -> torch.Tensor:
        """*Shape:* ``(V, 3)``."""
        return self.shapes.keyframes[self.first]

    @property
    def x_b(self) -> torch.Tensor:
        """*Shape:* ``(V, 3)``."""
        return self.shapes.keyframes[self.last]

    @property
    def faces(self) -> torch.Tensor:
        """*Shape:* ``(F, 3)``."""
        return self.shapes.faces

    def bases(self, n_modes: int = 30) -> list[tm.ModalBasis]:
        """Of both ends."""
        both = self.shapes.bases(n_modes)
        return [both[self.first], both[self.last]]

    def at(self, times: Iterable[float]) -> Case:
        """The same at other times."""
        return replace(self, times=tuple(times))


def spans(
    name: str, files: list[Path], ends: Iterable[tuple[int, int]], labels: list[str] | None = None, truth: bool = False
) -> Iterator[Case]:
    """Pairs out of a sequence; of a motion, the frames between both are the truth at their places."""
    frames, faces = tm.load_keyframes(files)
    ends = list(ends)
    used = sorted({i for pair in ends for i in pair})
    shapes = KeyframeSet(frames[used], faces)
    for i, j in ends:
        truths = {(k - i) / (j - i): frames[k] for k in range(i + 1, j)} if truth else {}
        pair = "/".join((labels or [file.stem for file in files])[k] for k in (i, j))
        yield Case(f"{name} {pair}", shapes, used.index(i), used.index(j), truths)


def folder(path: Path) -> Iterator[Case]:
    """All frames of a folder in the order of their names: the first and the last are key-frames, the others truth.

    Raises:
        SystemExit: There are fewer than two.
    """
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    if len(files) < 2:
        sys.exit(f"{path} holds {len(files)} meshes ({', '.join(SUFFIXES)}); a case needs two key-frames or more")
    yield from spans(path.name, files, [(0, len(files) - 1)], truth=True)


def files_of(name: str, *beginnings: str) -> list[Path]:
    """Meshes of a folder beside the project, those whose names begin so; none, with a word, where it is not there."""
    found = [file for start in beginnings or ("",) for file in sorted((DATA / name).glob(f"{start}*.obj"))]
    if not found:
        print(f"(without {name}: the folder {DATA / name} is not there)")
    return found


def keyframes_of(name: str, *beginnings: str) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Key-frames and faces of a sample or of such a folder; None where that is not there."""
    if name in SAMPLES:
        return load_sample(name)[:2]
    files = files_of(name, *beginnings)
    return tm.load_keyframes(files) if files else None


def animal(name: str) -> tuple[torch.Tensor, torch.Tensor, list[tuple[str, int, int]]]:
    """Frames and faces of an animal beside the project, and the name, the start and the end of each clip."""
    with np.load(DATA / "animals" / f"{name}.npz") as given:
        starts, lengths = given["clip_starts"].tolist(), given["clip_lengths"].tolist()
        clips = [(str(own), i, i + n) for own, i, n in zip(given["clip_names"], starts, lengths, strict=True)]
        return torch.tensor(given["frames"]).double(), torch.tensor(given["faces"]).long(), clips


def clips() -> Iterator[Case]:
    """Pairs of frames of each clip of the animals, 6, 10 and 16 frames apart about its middle, with the true one."""
    for file in sorted((DATA / "animals").glob("*.npz")):
        frames, faces, parts = animal(file.stem)
        for name, start, end in parts:
            for n in (n for n in (6, 10, 16) if n < end - start):
                first = start + (end - start - 1 - n) // 2
                if torch.allclose(frames[first], frames[first + n]):  # there and back again
                    continue
                shapes = KeyframeSet(frames[[first, first + n]], faces)
                yield Case(f"{file.stem} {name} {n}", shapes, 0, 1, {HALF: frames[first + n // 2]})


def divided(x: torch.Tensor, faces: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Shapes whose triangles are divided in four. *Shape:* ``(K, V, 3), (F, 3)``."""
    mesh = Connectivity(faces.numpy(), x.shape[1])
    i, j, k = faces.unbind(1)
    a, b, c = (torch.tensor(mesh.sides).view(3, -1) + x.shape[1]).unbind()  # of ij, jk, ki
    corners = ((i, a, c), (a, j, b), (c, b, k), (a, b, c))
    return torch.cat([x, x[:, mesh.edges].mean(2)], 1), torch.cat([torch.stack(face, 1) for face in corners])


def hand_path() -> Iterator[Case]:
    """Three spans of a closing hand."""
    if files := files_of("mh-hand-path"):
        yield from spans("mh-hand-path", files, [(0, 8), (0, 4), (4, 8)], truth=True)


def women() -> Iterator[Case]:
    """A figure at rest and in two steps of a walk, without a reference."""
    if files := files_of("mh-woman"):
        yield from spans("mh-woman", files, [(1, 2), (0, 1), (0, 2)], ["00", "02", "03"])


def shared() -> Iterator[Case]:
    """Every data set that is kept beside the project."""
    yield from hand_path()
    yield from women()
    for name, ends in (
        ("mh-hand", [(0, 3), (0, 4), (2, 3), (2, 4)]),
        ("ict-face", [(0, 1), (0, 2), (1, 2), (0, 3)]),
        ("hyper-cube", [(0, 1), (1, 2), (2, 3)]),
    ):
        if files := files_of(name):
            labels = [file.stem[:2] if file.stem[:2].isdigit() else file.stem[-1] for file in files]
            yield from spans(name, files, ends, labels)


def samples() -> Iterator[Case]:
    """All spans of the samples that come with the package."""
    for name in ("creature", "hand"):
        sample = load_sample(name)
        shapes = KeyframeSet(sample.keyframes, sample.faces)
        n = len(sample.keyframes)
        for i in range(n if sample.cyclic else n - 1):
            truths = {t - i: x for t, x in zip(sample.true_times, sample.truth, strict=True) if i < t < i + 1}
            yield Case(f"sample {name} {i}/{(i + 1) % n}", shapes, i, (i + 1) % n, truths)


def bodies(names: Iterable[str]) -> Iterator[Case]:
    """Synthetic bodies that bend far, and thin and hollow ones."""
    for name in names:
        shape = body(name)
        first, half, last = (torch.from_numpy(shape.pose(t)) for t in (0.0, HALF, 1.0))
        shapes = KeyframeSet(torch.stack([first, last]), torch.from_numpy(np.array(shape.faces)))
        quarters = {t: torch.from_numpy(shape.pose(t)) for t in (0.25, 0.75)}
        yield Case(name, shapes, 0, 1, {HALF: half, **quarters})
