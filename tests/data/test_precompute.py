"""Bases of folder trees: sets that are computed, skipped, computed again, refused; bad sets among good ones."""

import json
import os
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.data import precompute
from torch_modal.data.precompute import Options, Record, read_record
from torch_modal.data.stored import SET_FILE, StoredSet, find_sets, write_set
from torch_modal.io.write import save_mesh
from torch_modal.modes.processes import ChildError

FAILURES = {
    "crash": "its process ended with signal SIGSEGV",
    "hang": "no result after the timeout of {} s",
    "silent": "its process ended with exit code 1 (no luck)",
}
"""Ends of the processes of sets with these words in their names."""


class Bench:
    """A folder tree, an output folder, and the command, whose sets are computed at once, without a process."""

    def __init__(self, folder: Path, shapes: Shapes, capsys: pytest.CaptureFixture[str]) -> None:
        self.root, self.out, self.shapes, self._capsys = folder / "shapes", folder / "out", shapes, capsys
        self.said: list[str] = []
        self.started: list[str] = []

    def run_child(
        self, command: list[str], folder: Path, timeout: float, stop: object, job: bytes, environment: dict[str, str]
    ) -> None:
        """What a process would do with its job."""
        what = json.loads(job)
        name = Path(what["target"]).name
        self.started.append(name)
        assert environment["OMP_NUM_THREADS"] == "1" and environment["TMPDIR"] == str(folder)
        (folder / "leftover").write_text("x")
        for word, reason in FAILURES.items():
            if word in name:
                raise ChildError(reason.format(f"{timeout:g}"))
        record = Record("done", "", ["a bit open"] if "open" in name else [], 0.1, what["key"])
        names = ["1.obj", "2.obj", "3.obj"]
        write_set(what["target"], *self.shapes, names, note=json.dumps(asdict(record)))

    def add(self, *names: str) -> None:
        """Sets of two files, which nobody reads but to hash them."""
        for name in names:
            (self.root / name).mkdir(parents=True, exist_ok=True)
            for i in (1, 2):
                (self.root / name / f"{i}.obj").write_text(f"v {i} 0 0")

    def run(self, *options: str) -> int:
        """The command; the lines that it says on its two streams are in ``said``."""
        self._capsys.readouterr()
        code = cli.main(["precompute", str(self.root), "--out", str(self.out), *options])
        text = self._capsys.readouterr()
        self.said = (text.out + text.err).splitlines()
        return code

    def computed(self) -> list[str]:
        """Sets for which a process was started since this was last asked, sorted."""
        names = sorted(self.started)
        self.started.clear()
        return names

    def record(self, name: str) -> Record:
        """The record of a set."""
        found = read_record(self.out / name)
        assert found is not None
        return found


@pytest.fixture
def bench(tmp_path: Path, bars: Shapes, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Bench:
    """The command with no process for the sets."""
    made = Bench(tmp_path, bars, capsys)
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr(precompute, "run_child", made.run_child)
    monkeypatch.setattr(precompute.tempfile, "tempdir", str(tmp_path / "scratch"))
    return made


# --------------------------------------------------------------------------------------------- one run
def test_bad_sets_are_named_and_do_not_stop_the_others(bench: Bench) -> None:
    done = [*(f"good/{i}" for i in range(6)), "open"]
    bench.add(*FAILURES, *done)
    assert bench.run("--timeout", "3", "--workers", "4") == 3
    assert bench.computed() == sorted(name.split("/")[-1] for name in [*FAILURES, *done])
    assert not any((bench.out / name).exists() for name in FAILURES)
    for name in done:
        assert bench.record(name).status == "done" and len(StoredSet(bench.out / name)) == 3
    assert find_sets(bench.out) == sorted(bench.out / name for name in done)
    # The summary names them for somebody who did not watch.
    summary = bench.said[bench.said.index(next(line for line in bench.said if "have their bases" in line)) :]
    assert summary[0].startswith("7 of 10 sets have their bases; 10 were worked on now, in ")
    expected = {name: f"  failed {name}: {reason.format(3)}" for name, reason in FAILURES.items()}
    expected["open"] = "  done open, 0.1 s: a bit open"
    assert summary[1:] == [expected[name] for name in sorted(expected)]
    assert list((bench.root.parent / "scratch").iterdir()) == [], "temporary files are left"


def test_names_that_are_no_text(bench: Bench) -> None:
    """Names of files are bytes."""
    name = os.fsdecode(b"silent-\xff")
    bench.add("a", name)
    assert bench.run() == 3
    assert bench.record("a").status == "done" and read_record(bench.out / name) is None
    assert bench.run() == 3 and "silent" in bench.computed()[-1]
    assert bench.said[-1].startswith("  failed silent-\\udcff: ")


def test_as_many_sets_run_at_a_time_as_asked(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    alive, most = [], []

    def counting(*args: Any) -> None:
        alive.append(1)
        most.append(len(alive))
        time.sleep(0.1)
        bench.run_child(*args)
        alive.pop()

    monkeypatch.setattr(precompute, "run_child", counting)
    bench.add(*(f"s{i}" for i in range(7)))
    assert bench.run("--workers", "3") == 0
    assert max(most) == 3
    assert bench.said[0] == f"7 sets of key-frames in {bench.root}"
    assert bench.said[1].startswith("[1/7] done s") and bench.said[1].endswith(", 0.1 s")
    assert bench.run("--quiet") == 0 and bench.said == []


# --------------------------------------------------------------------------------------------- again
def test_a_second_run_computes_what_is_left(bench: Bench) -> None:
    bench.add("a", "b", "crash")
    assert bench.run("--workers", "2") == 3
    assert bench.computed() == ["a", "b", "crash"]
    stamps = [(path.stat().st_mtime_ns, path.stat().st_ino) for path in sorted(bench.out.rglob("*.safetensors"))]
    bench.add("c")
    assert bench.run() == 3
    assert bench.computed() == ["c", "crash"]  # what failed is tried again
    (bench.out / "c" / SET_FILE).rename(bench.root / "c.safetensors")
    assert [(p.stat().st_mtime_ns, p.stat().st_ino) for p in sorted(bench.out.rglob("*.safetensors"))] == stamps
    assert any("3 of 4 sets have their bases; 2 were worked on now" in line for line in bench.said)
    assert any("failed crash: its process ended with signal SIGSEGV" in line for line in bench.said)
    for file in bench.root.joinpath("crash").iterdir():
        file.unlink()
    assert bench.run() == 0 and bench.computed() == ["c"]  # its bases are gone


def test_changed_files_and_options_are_computed_again(bench: Bench) -> None:
    bench.add("a", "b")
    assert bench.run() == 0 and len(bench.computed()) == 2
    os.utime(bench.root / "a" / "1.obj")  # written anew with the same content
    assert bench.run() == 0 and bench.computed() == []
    (bench.root / "a" / "1.obj").write_text("v 5 0 0")
    assert bench.run() == 0 and bench.computed() == ["a"]
    assert bench.run("--modes", "40") == 0 and bench.computed() == ["a", "b"]
    assert bench.run("--modes", "40", "--timeout", "5", "--workers", "1") == 0 and bench.computed() == []
    assert bench.run("--modes", "40", "--sequence") == 0 and bench.computed() == ["a", "b"]


# --------------------------------------------------------------------------------------------- what is there
def test_stored_sets_of_others_are_replaced_only_if_asked(bench: Bench, bars: Shapes) -> None:
    bench.add("a", "b", "c")
    write_set(bench.out / "a", *bars.pick(0, 1), ["x", "y"])
    (bench.out / "c").mkdir()
    (bench.out / "c" / SET_FILE).write_bytes((bench.out / "a" / SET_FILE).read_bytes()[:-1])
    for _ in range(2):
        assert bench.run() == 3
        assert len(StoredSet(bench.out / "a")) == 2
        said = "holds a damaged set, or one that this command did not write; use --overwrite"
        assert sum(line.endswith(said) for line in bench.said if line.startswith("  failed")) == 2
    assert bench.computed() == ["b"]
    assert bench.run("--overwrite") == 0 and bench.computed() == ["a", "c"]
    assert len(StoredSet(bench.out / "a")) == 3
    # From then on it is ours.
    (bench.root / "a" / "1.obj").write_text("v 5 0 0")
    assert bench.run() == 0 and bench.computed() == ["a"]


def test_files_of_the_user_are_never_touched(bench: Bench) -> None:
    bench.add("a", "b", "a/inner")
    (bench.out / "a").mkdir(parents=True)
    for file in (bench.out / "a" / "labels.safetensors", bench.out / "b"):
        file.write_text("mine")
    assert bench.run("--overwrite") == 3 and bench.computed() == ["a", "b", "inner"]
    assert "File exists" in bench.said[-1]
    assert (bench.out / "b").read_text() == (bench.out / "a" / "labels.safetensors").read_text() == "mine"
    (bench.out / "b").unlink()
    (bench.root / "a" / "1.obj").write_text("v 5 0 0")
    assert bench.run() == 0 and bench.computed() == ["a", "b"]
    assert (bench.out / "a" / "labels.safetensors").read_text() == "mine"


def test_sets_within_sets_and_in_the_root(bench: Bench) -> None:
    names = [".", "a", "a/b", "n/m/k"]
    bench.add(*names)
    assert bench.run() == 0
    assert find_sets(bench.out) == [bench.out / name for name in names]
    bench.computed()
    assert bench.run() == 0 and bench.computed() == []


def test_folders_that_cannot_work_are_refused(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(root: Path, out: Path, *options: str) -> str:
        assert cli.main(["precompute", str(root), "--out", str(out), *options]) == 1
        return capsys.readouterr().err

    bench.add("a")
    assert "there is no folder" in refused(bench.root / "missing", bench.out)
    assert "there is no folder" in refused(bench.root / "a" / "1.obj", bench.out)
    assert "is or contains the input" in refused(bench.root, bench.root)
    assert "is or contains the input" in refused(bench.root / "a", bench.root)
    assert "must be positive, got 0" in refused(bench.root, bench.out, "--workers", "0")
    assert "File exists" in refused(bench.root, bench.root / "a" / "1.obj")
    lone = bench.root / "lone"
    lone.mkdir()
    (lone / "1.obj").write_text("")
    said = refused(lone, bench.out)
    assert "no folder below" in said and "left out .: it holds one mesh only" in said
    # The output may lie in the input: it is not searched.
    for _ in range(2):
        assert cli.main(["precompute", str(bench.root), "--out", str(bench.root / "bases")]) == 0
    assert bench.computed() == ["a"]


# --------------------------------------------------------------------------------------------- a set's own process
def test_real_sets(capsule: tuple[np.ndarray, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From files to bases that are those of the library, and real refusals."""
    vertices, faces = capsule
    root, out = tmp_path / "shapes", tmp_path / "out"
    shapes = np.stack([vertices * (1, 1, 1 + 0.1 * i) for i in range(11)])
    save_mesh(shapes, faces, tmp_path / "all", fmt="obj", stem="f")
    (root / "good").mkdir(parents=True)
    for i in (9, 10):
        (tmp_path / "all" / f"f-{i:03d}.obj").rename(root / "good" / f"frame-{i}.obj")
    save_mesh(shapes[:1], faces, root / "differs", fmt="obj", stem="a")
    save_mesh(shapes[:1], faces[1:], root / "differs", fmt="obj", stem="b")
    save_mesh(shapes[:1], faces, root / "twice", fmt="obj")
    save_mesh(shapes[:1], faces, root / "twice", fmt="ply")
    (root / "good" / "frame-9.mtl").write_text("")
    argv = ["precompute", str(root), "--out", str(out), "--modes", "4", "--mesher", "lattice"]
    assert cli.main(argv) == 3
    said = capsys.readouterr().out.splitlines()[-2:]
    assert said[0].startswith("  failed differs: ") and "faces" in said[0] and "b-000.obj" in said[0]
    assert said[1].endswith("(two files have the same name; a shape must be there in one format only)")
    assert [path.name for path in find_sets(out)] == ["good"]

    stored = StoredSet(out / "good")
    assert json.loads(stored.note)["status"] == "done"
    keyframes, own_faces = tm.load_keyframes([root / "good" / f"frame-{i}.obj" for i in (9, 10)])
    assert torch.equal(stored.keyframes, keyframes) and torch.equal(stored.faces, own_faces)
    assert stored.names == ("frame-9.obj", "frame-10.obj")
    torch.testing.assert_close(stored.keyframes, torch.from_numpy(shapes[9:]), rtol=1e-7, atol=1e-9)
    for mine, its in zip(tm.extract_bases(keyframes, own_faces, 4, mesher="lattice"), stored.bases, strict=True):
        torch.testing.assert_close(its.eigenvalues, mine.eigenvalues)
        torch.testing.assert_close(its.modes, mine.modes, rtol=1e-6, atol=1e-9)


def test_times_of_a_sequence(
    tmp_path: Path, capsule: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even ones, those of the file, a cycle's, and wrong ones; without bases, which have no part."""

    def extract(keyframes: torch.Tensor, *_: object, **__: object) -> list[tm.ModalBasis]:
        some = torch.ones(1, dtype=torch.float64)
        return [tm.ModalBasis(x, some, torch.ones_like(x)[None], some.expand(6)) for x in keyframes]

    monkeypatch.setattr(precompute, "extract_bases", extract)
    source, target = tmp_path / "a", tmp_path / "out"
    files = save_mesh(np.stack([capsule[0] * s for s in (1, 1.1, 1.2)]), capsule[1], source, fmt="obj")

    def compute(times: str | None, sequence: bool = True) -> StoredSet:
        if times is not None:
            (source / "times.txt").write_text(times)
        options = Options(sequence=sequence)
        precompute.compute(source, target, options.key(files), options)
        return StoredSet(target)

    for text, expected, cyclic in (
        (None, (0, 1, 2), False),
        ("0 0.25\n1e1\n", (0, 0.25, 10), False),
        ("0\n1\n2\n2.5", (0, 1, 2, 2.5), True),
    ):
        stored = compute(text)
        assert (stored.times, stored.cyclic) == (expected, cyclic)
    for text in ("0 1", "0 1 1", "0 one 2", "0 1 nan", ""):
        with pytest.raises(ValueError, match=r"times\.txt: "):
            compute(text)
    assert compute(None, sequence=False).times is None


def test_a_record_is_read_from_the_note_of_a_stored_set(tmp_path: Path, bars: Shapes) -> None:
    record = Record("done", "why", ["a\udcff/ü\n"], 1.5, "ab")
    assert read_record(tmp_path) is None and read_record(tmp_path / "missing") is None
    write_set(tmp_path, *bars, ["x", "y", "z"], note=json.dumps(asdict(record)))
    assert read_record(tmp_path) == record
    for note in ("", "[]", "{", '{"status": "done", "colour": 1}'):
        write_set(tmp_path, *bars, ["x", "y", "z"], note=note)
        with pytest.raises(ValueError, match="damaged set, or one that this command did not write"):
            read_record(tmp_path)
