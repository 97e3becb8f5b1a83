"""Key-frame sets on disk: whole or absent, mapped into memory, the same after reading."""

import os
import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from conftest import Shapes
from safetensors.torch import save_file

from torch_modal.data.dataset import stored_labels
from torch_modal.data.space import ShapeSpace
from torch_modal.data.stored import (
    BASES_FILE,
    KEYFRAMES_FILE,
    LABELS_FILE,
    RECORD_FILE,
    StoredSet,
    find_sets,
    open_set,
    write_set,
)
from torch_modal.precompute.basis import ModalBasis

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
    found = open_set(folder)
    assert (len(found), found.n_vertices, found.names) == (3, 30, NAMES)
    assert torch.equal(found.keyframes, small_bars.keyframes)
    assert found.keyframes.dtype == torch.float64
    assert torch.equal(found.faces, small_bars.faces)
    assert found.faces.dtype == torch.int64
    for mine, its in zip(found.bases, small_bars.bases, strict=True):
        assert_equal_bases(mine, its)


def test_times_of_a_motion(small_bars: Shapes, folder: Path) -> None:
    assert (open_set(folder).times, open_set(folder).cyclic) == (None, False)
    for times, cyclic in (((0.0, 0.1, 2.5), False), ((-1.0, 0.1, 2.5, 2.75), True)):
        write_set(folder, *small_bars, NAMES, times=torch.tensor(times, dtype=torch.float64), cyclic=cyclic)
        found = pickle.loads(pickle.dumps(open_set(folder)))
        assert (found.times, found.cyclic) == (times, cyclic)
        space = ShapeSpace.open(found)
        assert space.motion is not None and space.motion.times.tolist() == list(times)
        assert space.motion.cyclic == cyclic
    for wrong, message in (
        ({"times": (0, 1)}, r"needs one time for each key-frame: \(3,\)"),
        ({"times": (0, 1, 2), "cyclic": True}, r"\(4,\)"),
        ({"times": (0, 1, 1)}, "must ascend"),
        ({"cyclic": True}, r"need their times: range\(4\)"),
    ):
        with pytest.raises(ValueError, match=message):
            write_set(folder, *small_bars, NAMES, **wrong)
    assert open_set(folder).cyclic  # the last that was right


def test_numbers_of_modes_may_differ(small_bars: Shapes, tmp_path: Path) -> None:
    bases = [basis.truncate(k) for basis, k in zip(small_bars.bases, (1, 3, 2), strict=True)]
    write_set(tmp_path / "set", small_bars.keyframes.float(), small_bars.faces.int(), bases, NAMES)
    found = open_set(tmp_path / "set")
    assert [basis.n_modes for basis in found.bases] == [1, 3, 2]
    assert found.keyframes.dtype == torch.float64


def test_writing_into_a_mapped_tensor_leaves_the_file(small_bars: Shapes, folder: Path) -> None:
    open_set(folder).keyframes.zero_()
    open_set(folder).bases[0].modes.zero_()
    assert torch.equal(open_set(folder).keyframes, small_bars.keyframes)
    assert_equal_bases(open_set(folder).bases[0], small_bars.bases[0])


def test_pickle_carries_the_path_alone(folder: Path) -> None:
    found = open_set(folder)
    expected = found.bases[0].modes
    sent = pickle.dumps(found)
    assert len(sent) < 1000
    again = pickle.loads(sent)
    assert again.names == NAMES
    assert torch.equal(again.bases[0].modes, expected)


def test_replaces_a_set_and_nothing_else(small_bars: Shapes, folder: Path) -> None:
    write_set(folder, 2 * small_bars.keyframes, small_bars.faces, small_bars.bases, NAMES)
    assert torch.equal(open_set(folder).keyframes, 2 * small_bars.keyframes)
    assert sorted(path.name for path in folder.parent.iterdir()) == ["bars"]
    (folder / "between-0-1.safetensors").write_bytes(b"")  # made from a set, and out of date with it
    write_set(folder, *small_bars, NAMES)
    assert sorted(path.name for path in folder.iterdir()) == [BASES_FILE, KEYFRAMES_FILE]


def test_files_of_the_user_stay_when_a_set_is_replaced(small_bars: Shapes, folder: Path) -> None:
    save_file({"vertex_labels": torch.arange(30)}, folder / LABELS_FILE)
    (folder / "notes.txt").write_text("mine")
    (folder / RECORD_FILE).write_text("of the set that was there")
    write_set(folder, 2 * small_bars.keyframes, small_bars.faces, small_bars.bases, NAMES, beside={"x": b"y"})
    assert torch.equal(open_set(folder).keyframes, 2 * small_bars.keyframes)
    assert torch.equal(stored_labels(open_set(folder))["vertex_labels"], torch.arange(30))
    assert (folder / "notes.txt").read_text() == "mine" and (folder / "x").read_bytes() == b"y"
    assert not (folder / RECORD_FILE).exists()
    write_set(folder.parent / "new", *small_bars, NAMES)
    for place, what in ((folder.parent, "holds the folder bars"), (folder / "notes.txt", "is no folder")):
        with pytest.raises(FileExistsError, match=what):
            write_set(place, *small_bars, NAMES)
    (folder.parent / "other").mkdir()
    (folder.parent / "other" / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match=r"holds notes\.txt and no stored key-frame set"):
        write_set(folder.parent / "other", *small_bars, NAMES)
    assert [path.name for path in (folder.parent / "other").iterdir()] == ["notes.txt"]


def test_several_may_write_one_set_at_once(small_bars: Shapes, folder: Path) -> None:
    """The last one's set stays, whole, with the labels; nobody fails, and no temporary folder is left."""
    (folder / LABELS_FILE).write_text("mine")

    def write(scale: int) -> None:
        for _ in range(30):
            write_set(folder, scale * small_bars.keyframes, small_bars.faces, small_bars.bases, NAMES)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(1, 5)))
    scale = float(open_set(folder).keyframes.abs().max() / small_bars.keyframes.abs().max())
    assert scale in (1.0, 2.0, 3.0, 4.0)
    assert len(open_set(folder).bases) == 3
    assert (folder / LABELS_FILE).read_text() == "mine"
    assert sorted(path.name for path in folder.parent.iterdir()) == ["bars"]


def test_leftovers_are_removed_when_nobody_can_be_writing_them(small_bars: Shapes, folder: Path) -> None:
    names = [".bars.77-0123abcd.tmp", ".bars.78-0123abcd.tmp", ".bars.mine.tmp", ".other.77-0123abcd.tmp"]
    for name in names:
        (folder.parent / name).mkdir()
        if "77" in name:
            os.utime(folder.parent / name, (0, 0))
    write_set(folder, *small_bars, NAMES)
    assert sorted(path.name for path in folder.parent.iterdir()) == sorted(["bars", *names[1:]])


def test_a_failure_leaves_nothing_behind(small_bars: Shapes, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = {path: path.read_bytes() for path in folder.iterdir()}
    write, calls = Path.write_bytes, []

    def full_disk(path: Path, data: bytes) -> int:
        calls.append(path.name)
        if len(calls) == 2:
            raise OSError("No space left on device")
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(OSError, match="No space"):
        write_set(folder, 2 * small_bars.keyframes, small_bars.faces, small_bars.bases, NAMES)
    assert len(calls) == 2
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in folder.parent.iterdir()] == ["bars"]


def test_finds_sets_in_order(small_bars: Shapes, folder: Path) -> None:
    root = folder.parents[1]
    write_set(root / "a", *small_bars, NAMES)
    write_set(root / "deep" / ".bars.17.tmp", *small_bars, NAMES)
    (root / "half").mkdir()
    (root / "half" / KEYFRAMES_FILE).write_bytes(b"")
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
    with pytest.raises(FileNotFoundError, match=KEYFRAMES_FILE):
        open_set(folder.parent)
    whole = (folder / BASES_FILE).read_bytes()
    (folder / BASES_FILE).write_bytes(whole[:-1])
    with pytest.raises(ValueError, match="damaged"):
        open_set(folder)
    small_bars.bases[0].save(folder / BASES_FILE)
    with pytest.raises(ValueError, match=r"lacks the tensors 0\.reference"):
        open_set(folder)
    (folder / BASES_FILE).write_bytes((folder / KEYFRAMES_FILE).read_bytes())
    with pytest.raises(ValueError, match=r"torch_modal\.set"):
        StoredSet(folder)
