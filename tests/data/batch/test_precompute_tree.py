"""Many sets: what is computed, passed over, done again, refused; what a bad set does to the others."""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Shapes, processes, wait_until

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.data.batch import set_task, set_worker
from torch_modal.data.batch.precompute import Shard
from torch_modal.data.batch.record import Record, inputs_key
from torch_modal.data.stored import BASES_FILE, LABELS_FILE, find_sets, open_set, write_set
from torch_modal.io.frames import save_frames

REPORT = Shard().report

# In place of the process that computes a set: the set's name says what becomes of it. It is the product's own engine
# that starts it, keeps its time and reads what it left.
FAKE = """
import json, os, shutil, signal, subprocess, sys, time
job = json.loads(sys.stdin.readline())
name, record = os.path.basename(job["target"]), job["record"]
with open(os.environ["FAKE_LOG"], "a") as log:
    log.write(ascii(name)[1:-1] + " " + str(os.getpid()) + " " + os.environ["OMP_NUM_THREADS"] + "\\n")
open(os.path.join(os.environ["TMPDIR"], "leftover"), "w").write("x")
if "crash" in name:
    os.kill(os.getpid(), signal.SIGSEGV)
if "killed" in name:
    os.kill(os.getpid(), signal.SIGKILL)
if "hang" in name:
    time.sleep(60)
if "stubborn" in name:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    subprocess.run([sys.executable, "-c", "import time; time.sleep(60)", os.environ["TMPDIR"]])
if "silent" in name:
    sys.exit("no luck")
record.update(status="done", keyframes=3, vertices=164, finished="now", seconds=0.1)
if "open" in name:
    record["warnings"] = ["a bit open"]
if "refuse" in name:
    record.update(status="refused", reason="the faces differ")
else:
    shutil.copytree(os.environ["FAKE_SET"], job["target"], dirs_exist_ok=True)
    json.dump(record, open(os.path.join(job["target"], "precompute.json"), "w"))
if "lucky" in name:  # another run has done it, this one fails
    os.kill(os.getpid(), signal.SIGSEGV)
json.dump(record, open(sys.argv[1], "w"))
"""


class Bench:
    """A folder tree, an output folder, and the command."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.root, self.out, self.log, self._capsys = folder / "shapes", folder / "out", folder / "log", capsys
        self.said: list[str] = []

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
        names = [line.split()[0] for line in self.log.read_text().splitlines()] if self.log.exists() else []
        self.log.unlink(missing_ok=True)
        return sorted(names)

    def report(self) -> dict[str, dict]:
        """The lines of the report by set."""
        lines = [json.loads(line) for line in (self.out / REPORT).read_text().splitlines()]
        return {line["set"]: line for line in lines}


@pytest.fixture
def bench(tmp_path: Path, bars: Shapes, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Bench:
    """The command with a fake process for each set, which is up in no time."""
    made = Bench(tmp_path, capsys)
    (tmp_path / "worker.py").write_text(FAKE)
    write_set(tmp_path / "stored", *bars, ["1.obj", "2.obj", "3.obj"])
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr(set_task, "COMMAND", [sys.executable, str(tmp_path / "worker.py")])
    monkeypatch.setattr(set_task.tempfile, "tempdir", str(tmp_path / "scratch"))
    monkeypatch.setenv("FAKE_LOG", str(made.log))
    monkeypatch.setenv("FAKE_SET", str(tmp_path / "stored"))
    return made


# --------------------------------------------------------------------------------------------- one run
def test_bad_sets_are_reported_and_do_not_stop_the_others(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(set_task, "GRACE", 0.5)
    good = [f"good/{i}" for i in range(6)]
    bench.add("crash", "killed", "hang", "stubborn", "silent", "refuse", "open", "lucky", *good)
    assert bench.run("--timeout", "3", "--workers", "4") == 3
    assert bench.computed() == sorted([name.split("/")[-1] for name in bench.report()])
    report = bench.report()
    assert list(report) == ["crash", *good, "hang", "killed", "lucky", "open", "refuse", "silent", "stubborn"]
    wanted = {
        "crash": ("crashed", "its process ended with signal SIGSEGV"),
        "killed": ("crashed", "its process ended with signal SIGKILL (perhaps memory ran out)"),
        "hang": ("timeout", "no result after the timeout of 3 s"),
        "stubborn": ("timeout", "no result after the timeout of 3 s"),
        "silent": ("failed", "its process ended with exit code 1 (no luck)"),
        "refuse": ("refused", "the faces differ"),
    }
    for name, (status, reason) in wanted.items():
        assert (report[name]["status"], report[name]["reason"]) == (status, reason)
    for name in [*good, "lucky", "open"]:
        line = report[name]
        assert line["status"] == "done" and line["seconds"] > 0 and line["keyframes"] == 3 and line["vertices"] == 164
        assert line["files"] == ["1.obj", "2.obj"] and line["parameters"]["n_modes"] == 30
        assert len(open_set(bench.out / line["output"])) == 3
    assert 2.9 < report["hang"]["seconds"] < 20
    assert "no luck" in report["silent"]["log"]
    assert find_sets(bench.out) == sorted(bench.out / name for name in [*good, "lucky", "open"])
    # The summary says all of it, to somebody who did not watch.
    summary = bench.said[bench.said.index(next(line for line in bench.said if "have their bases" in line)) :]
    assert summary[0].startswith("8 of 14 sets have their bases; 14 were worked on now, in ")
    for name, (status, reason) in wanted.items():
        assert f"  {status} {name}: {reason}" in summary
    assert any(line.startswith("  done open: ") and line.endswith("; a bit open") for line in summary)
    assert summary[-1] == f"report: {bench.out / REPORT}" and len(summary) == 9
    scratch = bench.root.parent / "scratch"
    assert list(scratch.iterdir()) == [], "temporary files are left"
    # What a process has started is killed with it, which takes a moment where the machine is busy.
    wait_until(lambda: not processes(str(scratch)), 10)


def test_names_that_are_no_text(bench: Bench) -> None:
    """Names of files are bytes."""
    name = os.fsdecode(b"refuse-\xff\n")
    bench.add("a", name)
    assert bench.run() == 3
    assert {line["set"]: line["status"] for line in bench.report().values()} == {"a": "done", name: "refused"}
    assert bench.run("--retry") == 3 and "refuse" in bench.computed()[-1]


def test_processes_have_one_thread_and_as_many_run_as_asked(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    alive, most, wait = [], [], set_task._wait

    def counting(*args: object) -> object:
        alive.append(1)
        most.append(len(alive))
        try:
            return wait(*args)  # type: ignore[arg-type]
        finally:
            alive.pop()

    monkeypatch.setattr(set_task, "_wait", counting)
    bench.add(*(f"s{i}" for i in range(7)))
    assert bench.run("--workers", "3") == 0
    assert max(most) == 3
    assert bench.said[0] == f"7 sets of key-frames in {bench.root}"
    assert bench.said[1].startswith("[1/7] done s") and ": 3 key-frames of 164 vertices, " in bench.said[1]
    assert bench.run("--quiet") == 0 and bench.said == []
    assert {line.split()[2] for line in bench.log.read_text().splitlines()} == {"1"}


def test_a_bar_is_for_terminals_and_leaves_lines_to_failures(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.add("a", "silent")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    assert cli.main(["precompute", str(bench.root), "--out", str(bench.out)]) == 3
    said = bench._capsys.readouterr()
    assert "/2 [" in said.err and "set/s]" in said.err
    lines = [line for line in said.out.splitlines() if line.startswith("[")]
    assert len(lines) == 1 and " failed silent: " in lines[0]


# --------------------------------------------------------------------------------------------- again
def test_a_second_run_does_what_is_left(bench: Bench) -> None:
    bench.add("a", "b", "crash")
    assert bench.run("--workers", "2") == 3
    assert bench.computed() == ["a", "b", "crash"]
    files = sorted(path for path in bench.out.rglob("*") if path.is_file() and path.suffix == ".safetensors")
    stamps = [(path.stat().st_mtime_ns, path.stat().st_ino) for path in files]
    before = bench.report()
    bench.add("c")
    assert bench.run() == 3
    assert bench.computed() == ["c"]
    assert [(path.stat().st_mtime_ns, path.stat().st_ino) for path in files] == stamps
    assert {name: line for name, line in bench.report().items() if name != "c"} == before
    assert any("3 of 4 sets have their bases; 1 were worked on now" in line for line in bench.said)
    assert any("crashed crash: its process ended with signal SIGSEGV" in line for line in bench.said)


def test_failed_sets_are_tried_again_if_asked_or_changed(bench: Bench) -> None:
    bench.add("a", "crash", "refuse")
    assert bench.run() == 3 and len(bench.computed()) == 3
    assert bench.run("--retry") == 3 and bench.computed() == ["crash", "refuse"]
    bench.root.joinpath("refuse", "2.obj").write_text("v 3 0 0")
    assert bench.run() == 3 and bench.computed() == ["refuse"]
    for name in ("crash", "refuse"):
        for file in bench.root.joinpath(name).iterdir():
            file.unlink()
        bench.root.joinpath(name).rmdir()
    assert bench.run() == 0 and bench.computed() == []
    assert list(bench.report()) == ["a"]


def test_changed_files_and_options_are_done_again_and_said(bench: Bench) -> None:
    bench.add("a", "b")
    assert bench.run() == 0 and len(bench.computed()) == 2
    os.utime(bench.root / "a" / "1.obj")  # written anew with the same content
    assert bench.run() == 0 and bench.computed() == []
    (bench.root / "a" / "1.obj").write_text("v 5 0 0")
    assert bench.run() == 0 and bench.computed() == ["a"]
    assert any(line.startswith("[") and "done a (its files changed): " in line for line in bench.said)
    assert bench.report()["a"]["reason"] == "its files changed" and "reason" not in bench.report()["b"]
    assert bench.run("--modes", "40") == 0 and bench.computed() == ["a", "b"]
    assert bench.report()["b"]["reason"] == "n_modes changed from 30 to 40"
    assert bench.run("--modes", "40", "--timeout", "5", "--workers", "1") == 0 and bench.computed() == []


def test_sequences_are_made_when_asked_and_again_when_their_times_change(bench: Bench) -> None:
    bench.add("a")
    times = bench.root / "a" / "times.txt"
    times.write_text("0 1")
    assert bench.run() == 0 and bench.computed() == ["a"]
    times.write_text("0 2")
    assert bench.run() == 0 and bench.computed() == []  # nobody asked for them
    assert bench.run("--sequence") == 0 and bench.computed() == ["a"]
    assert bench.report()["a"]["reason"].endswith("sequence changed from None to True")
    assert bench.run("--sequence") == 0 and bench.computed() == []
    times.write_text("0 3")
    assert bench.run("--sequence") == 0 and bench.computed() == ["a"]
    assert bench.report()["a"]["reason"] == "its files changed"
    assert bench.run() == 0 and bench.computed() == ["a"]
    assert bench.report()["a"]["reason"].endswith("sequence changed from True to None")


def test_damaged_or_missing_bases_are_made_again(bench: Bench) -> None:
    bench.add("a", "b", "c")
    assert bench.run() == 0 and len(bench.computed()) == 3
    file = bench.out / "a" / BASES_FILE
    file.write_bytes(file.read_bytes()[:-8])
    (bench.out / "b" / BASES_FILE).unlink()
    assert bench.run() == 0 and bench.computed() == ["a", "b"]
    assert bench.report()["a"]["reason"].startswith("its bases are gone or damaged: ")
    assert len(open_set(bench.out / "a").bases) == 3


def test_bases_of_earlier_files_are_named_when_the_new_ones_fail(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.add("a")
    assert bench.run() == 0
    (bench.root / "a" / "1.obj").write_text("v 5 0 0")
    bench.log.with_name("worker.py").write_text("raise SystemExit(1)")
    assert bench.run() == 3
    assert bench.report()["a"]["warnings"] == [f"{bench.out / 'a'} still holds the bases of earlier files or settings"]
    assert len(open_set(bench.out / "a")) == 3


# --------------------------------------------------------------------------------------------- what is there
def test_stored_sets_of_others_are_replaced_only_if_asked(bench: Bench, bars: Shapes) -> None:
    bench.add("a", "b")
    write_set(bench.out / "a", *bars.pick(0, 1), ["x", "y"])
    for _ in range(2):
        assert bench.run() == 3
        assert len(open_set(bench.out / "a")) == 2
        assert bench.report()["a"]["reason"].endswith("that this command did not write; --overwrite replaces it")
    assert bench.computed() == ["b"]
    assert bench.run("--overwrite") == 0 and bench.computed() == ["a"]
    assert len(open_set(bench.out / "a")) == 3
    # From then on it is ours.
    (bench.root / "a" / "1.obj").write_text("v 5 0 0")
    assert bench.run() == 0 and bench.computed() == ["a"]


def test_files_of_the_user_are_never_touched(bench: Bench) -> None:
    bench.add("a", "b", "c")
    for file in (bench.out / "a" / "notes.txt", bench.out / "b", bench.out / "c" / LABELS_FILE):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("mine")
    assert bench.run("--overwrite") == 3 and bench.computed() == ["c"]
    assert "holds notes.txt and no stored key-frame set; move it away" in bench.report()["a"]["reason"]
    assert "is no folder" in bench.report()["b"]["reason"]
    assert [path.name for path in (bench.out / "a").iterdir()] == ["notes.txt"]
    assert (bench.out / "b").read_text() == (bench.out / "c" / LABELS_FILE).read_text() == "mine"
    (bench.out / "a" / "notes.txt").unlink()
    (bench.out / "b").unlink()
    assert bench.run() == 0 and bench.computed() == ["a", "b"]
    (bench.root / "c" / "1.obj").write_text("v 5 0 0")  # labels beside a set are no obstacle to doing it again
    assert bench.run() == 0 and bench.computed() == ["c"]
    assert (bench.out / "c" / LABELS_FILE).read_text() == "mine"


def test_sets_within_sets_and_in_the_root_have_places(bench: Bench) -> None:
    bench.add(".", "a", "a/b", "n", "n/m/k", "n/n")
    assert bench.run() == 0
    places = {name: line["output"] for name, line in bench.report().items()}
    assert places == {".": "shapes", "a": "a/a", "a/b": "a/b", "n": "n/n_", "n/m/k": "n/m/k", "n/n": "n/n"}
    assert find_sets(bench.out) == sorted(bench.out / place for place in places.values())
    bench.computed()
    assert bench.run() == 0 and bench.computed() == []


def test_folders_that_cannot_work_are_refused(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(root: Path, out: Path, *options: str) -> str:
        assert cli.main(["precompute", str(root), "--out", str(out), *options]) == 1
        return capsys.readouterr().err

    bench.add("a")
    assert "there is no folder" in refused(bench.root / "missing", bench.out)
    assert "is no folder" in refused(bench.root / "a" / "1.obj", bench.out)
    assert "is or contains the input" in refused(bench.root, bench.root)
    assert "is or contains the input" in refused(bench.root / "a", bench.root)
    assert "is a file" in refused(bench.root, bench.root / "a" / "1.obj")
    lone = bench.root / "lone"
    lone.mkdir()
    (lone / "1.obj").write_text("")
    said = refused(lone, bench.out)
    assert "no folder below" in said and "holds one mesh only, 1.obj" in said
    # The output may lie in the input: it is not searched.
    for _ in range(2):
        assert cli.main(["precompute", str(bench.root), "--out", str(bench.root / "bases")]) == 0
    assert bench.computed() == ["a"]


# --------------------------------------------------------------------------------------------- a set's own process
def test_real_sets(capsule: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    """From files to bases that are those of the library, and real refusals."""
    vertices, faces = capsule
    root, out = tmp_path / "shapes", tmp_path / "out"
    shapes = np.stack([vertices * (1, 1, 1 + 0.1 * i) for i in range(11)])
    save_frames(shapes[:2], faces, root / "good", fmt="obj", stem="key")
    save_frames(shapes, faces, tmp_path / "all", fmt="obj", stem="f")
    (root / "order").mkdir(parents=True)
    for i in (9, 10):
        (tmp_path / "all" / f"f-{i:03d}.obj").rename(root / "order" / f"frame-{i}.obj")
    save_frames(shapes[:1], faces, root / "differs", fmt="obj", stem="a")
    save_frames(shapes[:1], faces[1:], root / "differs", fmt="obj", stem="b")
    save_frames(shapes[:1], faces, root / "twice", fmt="obj")
    save_frames(shapes[:1], faces, root / "twice", fmt="ply")
    (root / "good" / "key-001.mtl").write_text("")
    argv = ["precompute", str(root), "--out", str(out), "--modes", "4", "--mesher", "lattice"]
    assert cli.main(argv) == 3
    report = {line["set"]: line for line in map(json.loads, (out / REPORT).read_text().splitlines())}
    assert [line["status"] for line in report.values()] == ["refused", "done", "done", "refused"]
    assert "faces" in report["differs"]["reason"] and "b-000.obj" in report["differs"]["reason"]
    assert "2 files have the name frame-000" in report["twice"]["reason"]
    assert "warnings" not in report["good"]

    stored = open_set(out / "good")
    keyframes, own_faces = tm.load_keyframes(sorted((root / "good").glob("*.obj")))
    assert torch.equal(stored.keyframes, keyframes) and torch.equal(stored.faces, own_faces)
    assert stored.names == ("key-000.obj", "key-001.obj")
    assert open_set(out / "order").names == ("frame-9.obj", "frame-10.obj")
    torch.testing.assert_close(open_set(out / "order").keyframes, torch.from_numpy(shapes[9:]), rtol=0, atol=0)
    for mine, its in zip(tm.extract_bases(keyframes, own_faces, 4, mesher="lattice"), stored.bases, strict=True):
        torch.testing.assert_close(its.eigenvalues, mine.eigenvalues)
        torch.testing.assert_close(its.modes, mine.modes, rtol=1e-6, atol=1e-9)


def test_worker_says_what_is_wrong(
    tmp_path: Path, capsule: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each kind of error in the process of a set, and what the report calls it."""
    files = save_frames(np.stack([capsule[0], 1.1 * capsule[0]]), capsule[1], tmp_path / "a", fmt="obj")
    record = {"set": "a", "files": [file.name for file in files], "inputs": inputs_key(files)}
    job = {"record": record, "options": {}, "source": str(tmp_path / "a"), "target": str(tmp_path / "out" / "a")}

    def outcome(error: Exception) -> Record:
        def extract(*_: object, **__: object) -> None:
            raise error

        monkeypatch.setattr(set_worker, "extract_bases", extract)
        return set_worker.compute(job)

    refused = outcome(tm.MeshError("it is\nflat"))
    assert (refused.status, refused.reason, refused.vertices) == ("refused", "it is flat", len(capsule[0]))
    assert outcome(RuntimeError("no tetrahedra")).status == "failed"
    assert outcome(MemoryError()).reason == "MemoryError: "
    assert outcome(FileExistsError(17, "there", "x")).reason == "FileExistsError: [Errno 17] there: 'x'"
    bug = outcome(KeyError("k"))
    assert (bug.status, bug.reason) == ("failed", "KeyError: 'k'") and "Traceback" in bug.log
    files[0].write_text(files[0].read_text() + "# more")
    assert "were written to while they were read" in set_worker.compute(job).reason


def test_times_of_a_sequence(
    tmp_path: Path, capsule: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even ones, those of the file, a cycle's, and what is wrong with others; without bases, which have no part."""

    def extract(keyframes: torch.Tensor, *_: object, **__: object) -> list[tm.ModalBasis]:
        some = torch.ones(1, dtype=torch.float64)
        return [tm.ModalBasis(x, some, torch.ones_like(x)[None], some.expand(6)) for x in keyframes]

    monkeypatch.setattr(set_worker, "extract_bases", extract)
    files = save_frames(np.stack([capsule[0] * s for s in (1, 1.1, 1.2)]), capsule[1], tmp_path / "a", fmt="obj")
    job = {"options": {"sequence": True}, "source": str(tmp_path / "a"), "target": str(tmp_path / "out" / "a")}

    def outcome(times: str | None) -> Record:
        beside = [] if times is None else [tmp_path / "a" / "times.txt"]
        for file in beside:
            file.write_text(times or "")
        record = {"set": "a", "files": [file.name for file in files], "inputs": inputs_key([*files, *beside])}
        return set_worker.compute({**job, "record": record})

    for text, expected, cyclic in (
        (None, (0, 1, 2), False),
        ("0 0.25\n1e1\n", (0, 0.25, 10), False),
        ("0\n1\n2\n2.5", (0, 1, 2, 2.5), True),
    ):
        made = outcome(text)
        assert made.status == "done", made.reason
        stored = open_set(tmp_path / "out" / "a")
        assert (stored.times, stored.cyclic) == (expected, cyclic)
    for text in ("0 1", "0 1 1", "0 one 2", "0 1 nan", ""):
        wrong = outcome(text)
        assert wrong.status == "refused"
        assert "times.txt needs one number for each of the 3 key-frames, ascending" in wrong.reason
    job["options"] = {}
    assert (
        set_worker.compute(
            {**job, "record": {"set": "a", "files": [f.name for f in files], "inputs": inputs_key(files)}}
        ).status
        == "done"
    )
    assert open_set(tmp_path / "out" / "a").times is None
