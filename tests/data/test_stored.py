"""Key-frame sets on disk: whole or absent, mapped into memory, the same after reading."""

from pathlib import Path

import pytest
import torch
from conftest import Shapes

from torch_modal.data.space import ShapeSpace
from torch_modal.data.stored import (
    FORMAT,
    SET_FILE,
    VERSION,
    StoredSet,
    find_sets,
    read_note,
    write_set,
)
from torch_modal.io.tensors import write_tensors
from torch_modal.modes.basis import ModalBasis

NAMES = ("straight.obj", "bent.obj", "twisted.obj")


@pytest.fixture
def folder(small_bars: Shapes, tmp_path: Path) -> Path:
    write_set(tmp_path / "deep" / "bars", *small_bars, NAMES)
    return tmp_path / "deep" / "bars"


def assert_equal_bases(a: ModalBasis, b: ModalBasis) -> None:
    for part in ("reference", "eigenvalues", "modes", "rigid_eigenvalues"):
        assert torch.equal(getattr(a, part), getattr(b, part)), part


def test_reads_what_was_written(small_bars: Shapes, folder: Path) -> None:
    assert sorted(path.name for path in folder.parent.iterdir()) == ["bars"]
    found = StoredSet(folder)
    assert (len(found), found.n_vertices, found.names) == (3, 30, NAMES)
    assert torch.equal(found.keyframes, small_bars.keyframes)
    assert found.keyframes.dtype == torch.float64
    assert torch.equal(found.faces, small_bars.faces)
    assert found.faces.dtype == torch.int64
    for mine, its in zip(found.bases, small_bars.bases, strict=True):
        assert_equal_bases(mine, its)


def test_times_of_a_motion(small_bars: Shapes, folder: Path) -> None:
    assert (StoredSet(folder).times, StoredSet(folder).cyclic) == (None, False)
    for times, cyclic in (((0.0, 0.1, 2.5), False), ((-1.0, 0.1, 2.5, 2.75), True)):
        write_set(folder, *small_bars, NAMES, times=torch.tensor(times, dtype=torch.float64), cyclic=cyclic)
        found = StoredSet(folder)
        assert (found.times, found.cyclic) == (times, cyclic)
        space = ShapeSpace.open(found)
        assert space.motion is not None and space.motion.tolist() == list(times) and space.cyclic == cyclic
    for wrong, message in (
        ({"times": (0, 1)}, "must be 3 ascending numbers, one for each key-frame"),
        ({"times": (0, 1, 2), "cyclic": True}, "must be 4 ascending numbers"),
        ({"times": (0, 1, 1)}, "got 1 at place 2, after 1"),
    ):
        with pytest.raises(ValueError, match=message):
            write_set(folder, *small_bars, NAMES, **wrong)
    assert StoredSet(folder).cyclic  # the last that was right


def test_numbers_of_modes_may_differ(small_bars: Shapes, tmp_path: Path) -> None:
    bases = [basis.truncate(k) for basis, k in zip(small_bars.bases, (1, 3, 2), strict=True)]
    write_set(tmp_path / "set", small_bars.keyframes.float(), small_bars.faces.int(), bases, NAMES)
    found = StoredSet(tmp_path / "set")
    assert [basis.n_modes for basis in found.bases] == [1, 3, 2]
    assert found.keyframes.dtype == torch.float64


def test_writing_into_a_mapped_tensor_leaves_the_file(small_bars: Shapes, folder: Path) -> None:
    StoredSet(folder).keyframes.zero_()
    StoredSet(folder).bases[0].modes.zero_()
    assert torch.equal(StoredSet(folder).keyframes, small_bars.keyframes)
    assert_equal_bases(StoredSet(folder).bases[0], small_bars.bases[0])


def test_replaces_a_set_and_nothing_else(small_bars: Shapes, folder: Path) -> None:
    (folder / "notes.txt").write_text("mine")
    (folder / "between-0-1.safetensors").write_bytes(b"")  # made from a set, and out of date with it
    write_set(folder, 2 * small_bars.keyframes, small_bars.faces, small_bars.bases, NAMES, note="new")
    assert torch.equal(StoredSet(folder).keyframes, 2 * small_bars.keyframes)
    assert StoredSet(folder).note == read_note(folder) == "new"
    assert (folder / "notes.txt").read_text() == "mine"
    assert sorted(path.name for path in folder.iterdir()) == ["notes.txt", SET_FILE]
    with pytest.raises(OSError, match=r"notes\.txt"):
        write_set(folder / "notes.txt", *small_bars, NAMES)


def test_finds_sets_in_order(small_bars: Shapes, folder: Path) -> None:
    root = folder.parents[1]
    write_set(root / "a", *small_bars, NAMES)
    write_set(root / "deep" / ".hidden", *small_bars, NAMES)
    assert find_sets(root) == [root / "a", root / "deep" / "bars"]
    assert find_sets(str(folder)) == [folder]
    with pytest.raises(FileNotFoundError, match="no folder"):
        find_sets(root / "nowhere")


def test_refuses_parts_that_do_not_fit(small_bars: Shapes, bars: Shapes, tmp_path: Path) -> None:
    keyframes, faces, bases = small_bars
    for wrong in (
        (keyframes[0], faces, bases, NAMES),
        (keyframes, faces.flatten(), bases, NAMES),
        (keyframes, faces, bases[:2], NAMES),
        (keyframes, faces, bars.bases, NAMES),
        (keyframes, faces, bases, NAMES[:1]),
    ):
        with pytest.raises(ValueError, match="need"):
            write_set(tmp_path / "set", *wrong)
    assert not list(tmp_path.iterdir())


def test_refuses_what_is_no_set(small_bars: Shapes, folder: Path) -> None:
    with pytest.raises(FileNotFoundError, match=SET_FILE):
        StoredSet(folder.parent)
    write_tensors(folder / SET_FILE, FORMAT, VERSION, {"keyframes": small_bars.keyframes})
    with pytest.raises(ValueError, match="lacks the tensors faces"):
        read_note(folder)
