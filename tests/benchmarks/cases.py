"""Pairs of key-frames that the benchmarks run on, with a reference in-between and a basis for both ends."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch

import torch_modal as tm
from torch_modal.sample_data import load_sample

DATA = Path(__file__).parents[2].parent / "shared" / "data"


class Case(NamedTuple):
    """Two key-frames and what lies half-way between them."""

    name: str
    x_a: torch.Tensor
    x_b: torch.Tensor
    truth: torch.Tensor | None
    faces: torch.Tensor
    bases: list[tm.ModalBasis]


def hand_path() -> Iterator[Case]:
    """Three spans of a closing hand; nothing, with a word, where the data is not there."""
    folder = DATA / "mh-hand-path"
    if not folder.is_dir():
        print(f"(no hand path: the folder {folder} is not there)")
        return
    keyframes, faces = tm.load_keyframes([folder / f"{i:02}.obj" for i in (0, 2, 4, 6, 8)])
    bases = tm.extract_bases(keyframes, faces)
    for i, j, k in ((0, 4, 2), (0, 2, 1), (2, 4, 3)):
        name = f"hand path {2 * i:02}/{2 * j:02}"
        yield Case(name, keyframes[i], keyframes[j], keyframes[k], faces, [bases[i], bases[j]])


def women() -> Iterator[Case]:
    """Two spans of a walk, without a reference."""
    folder = DATA / "mh-woman"
    if not folder.is_dir():
        print(f"(no walking figure: the folder {folder} is not there)")
        return
    names = ("00-rest", "02-walk-a", "03-walk-b")
    keyframes, faces = tm.load_keyframes([folder / f"{name}.obj" for name in names])
    bases = tm.extract_bases(keyframes, faces)
    for i, j in ((1, 2), (0, 1)):
        name = f"woman {names[i][:2]}/{names[j][:2]}"
        yield Case(name, keyframes[i], keyframes[j], None, faces, [bases[i], bases[j]])


def samples() -> Iterator[Case]:
    """The first span of each sample that comes with the package."""
    for name in ("creature", "hand"):
        sample = load_sample(name)
        x_a, x_b = sample.keyframes[:2]
        bases = tm.extract_bases([x_a, x_b], sample.faces)
        truth = sample.truth[sample.true_times.index(0.5)]
        yield Case(f"sample {name} 0/1", x_a, x_b, truth, sample.faces, bases)
