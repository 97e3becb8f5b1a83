"""Files of numbers in which single bytes were changed: each load gives the same numbers, or a ValueError."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes
from safetensors.torch import load_file, save_file

import torch_modal as tm
from torch_modal.codec.sequence import STORED
from torch_modal.data.in_betweens import FORMAT, VERSION
from torch_modal.data.stored import SET_FILE, StoredSet, write_set
from torch_modal.io.tensors import read_tensors, write_tensors

N_IN_NUMBERS = 60
"""Places among the numbers; beside all bytes of short headers."""


@dataclass
class Case:
    path: Path
    load: Callable[[], list[Any]]
    """Everything that the file says."""
    refuses: bool = True
    """Whether damage is a ValueError; tables are computed again instead."""


def parts_of(basis: tm.ModalBasis) -> list[torch.Tensor]:
    return [basis.reference, basis.eigenvalues, basis.modes, basis.rigid_eigenvalues]


def made(kind: str, bars: Shapes, folder: Path) -> Case:
    """One file of each kind."""
    if kind == "basis":
        path = folder / "a.safetensors"
        bars.bases[0].truncate(2).save(path)
        return Case(path, lambda: parts_of(tm.ModalBasis.load(path)))
    if kind == "sequence":
        path = folder / "a.tms"
        frames = torch.lerp(bars.keyframes[0], bars.keyframes[1], torch.linspace(0, 1, 5).double()[:, None, None])
        tm.encode(frames, bars.faces, [0, 4], 4, times=[0, 1, 2, 3, 5]).save(path)

        def load() -> list[Any]:
            found = tm.ModalSequence.load(path)
            return [getattr(found, name) for name in STORED]

        return Case(path, load)
    if kind == "table":
        path, key = folder / "between-0-1.safetensors", {"key": "abc"}
        write_tensors(path, FORMAT, VERSION, {"shapes": bars.keyframes[:2].float().repeat(2, 1, 1)}, key)

        def load_table() -> list[Any]:
            stored = read_tensors(path, FORMAT, VERSION, key)
            return [None if stored is None else stored["shapes"]]

        return Case(path, load_table, refuses=False)
    bases = [basis.truncate(2) for basis in bars.bases[:2]]
    write_set(folder / "set", bars.keyframes[:2], bars.faces, bases, ["a", "b"], times=[1.0, 2.0, 4.0], cyclic=True)

    def load_set() -> list[Any]:
        stored = StoredSet(folder / "set")
        found = [stored.names, stored.times, stored.cyclic, len(stored), stored.n_vertices]
        return [*found, stored.keyframes, stored.faces, *(part for basis in stored.bases for part in parts_of(basis))]

    return Case(folder / "set" / SET_FILE, load_set)


KINDS = ("basis", "sequence", "table", "set")


def everything(case: Case) -> list[Any]:
    """Copies: what is mapped would change along with the file."""
    return [part.clone() if isinstance(part, torch.Tensor) else part for part in case.load()]


def same(one: Any, other: Any) -> bool:
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    return type(one) is type(other) and one == other


@pytest.mark.parametrize("kind", KINDS)
def test_a_changed_byte_is_an_error_or_changes_nothing(kind: str, small_bars: Shapes, tmp_path: Path) -> None:
    case = made(kind, small_bars, tmp_path)
    data, before = case.path.read_bytes(), everything(case)
    start = 8 + int.from_bytes(data[:8], "little")
    rng = np.random.default_rng(0)
    header = rng.permutation(start)[:400].tolist()
    found_out = 0
    for place in [*header, *rng.integers(start, len(data), N_IN_NUMBERS).tolist(), len(data) - 1]:
        damaged = bytearray(data)
        damaged[place] ^= 1 << int(rng.integers(8))
        case.path.write_bytes(damaged)
        try:
            after = case.load()
        except ValueError as error:
            assert case.refuses and str(case.path) in str(error), place
            found_out += 1
            continue
        if not case.refuses and after == [None]:
            found_out += 1
            continue
        assert all(map(same, after, before)), f"byte {place} of {len(data)} ({start} of the header)"
    assert found_out > N_IN_NUMBERS


@pytest.mark.parametrize("kind", KINDS)
def test_files_without_digests_are_damaged(kind: str, small_bars: Shapes, tmp_path: Path) -> None:
    case = made(kind, small_bars, tmp_path)
    data = case.path.read_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    tensors = load_file(case.path)
    assert tensors.pop("digests").dtype == torch.uint8
    save_file(tensors, case.path, header["__metadata__"])
    if case.refuses:
        with pytest.raises(ValueError, match="is damaged"):
            case.load()
    else:
        assert case.load() == [None]
