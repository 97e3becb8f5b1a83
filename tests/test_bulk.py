"""Many sets: what is computed, passed over, done again, refused; what a bad set does to the others."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Shapes, listen_to_ctrl_c

import torch_modal as tm
from torch_modal.bulk import _set_worker, review, set_process
from torch_modal.bulk import records as r
from torch_modal.bulk.progress import Progress, printable
from torch_modal.bulk.records import Record, Records
from torch_modal.bulk.run import default_workers
from torch_modal.bulk.sharing import Counts
from torch_modal.cli import main as cli
from torch_modal.data.stored import BASES_FILE, find_sets, open_set, write_set
from torch_modal.io.write import save_frames

# In place of the process that computes a set: the set's name says what becomes of it. It is the product's own engine
# that starts it, keeps its time and reads what it left.
FAKE = """
import json, os, shutil, signal, sys, time
job = json.load(open(sys.argv[1]))
name = os.path.basename(job["folder"])
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
    time.sleep(60)
if "silent" in name:
    sys.exit("no luck")
if "touching" in name:
    with open(job["files"][0], "a") as file:
        file.write("# more")
result = {"status": "done", "keyframes": 3, "vertices": 164, "warnings": ["a bit open"] if "open" in name else []}
if "refuse" in name:
    result = {"status": "refused", "reason": "the faces differ"}
else:
    shutil.copytree(os.environ["FAKE_SET"], job["folder"], dirs_exist_ok=True)
with open(sys.argv[2], "w") as file:
    json.dump(result, file)
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
        lines = [json.loads(line) for line in (self.out / r.REPORT).read_text().splitlines()]
        return {line["set"]: line for line in lines}

    def status(self) -> dict[str, str]:
        return {name: line["status"] for name, line in self.report().items()}


@pytest.fixture
def bench(tmp_path: Path, bars: Shapes, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Bench:
    """The command with a fake process for each set, which is up in no time."""
    made = Bench(tmp_path, capsys)
    (tmp_path / "worker.py").write_text(FAKE)
    write_set(tmp_path / "stored", *bars, ["1.obj", "2.obj", "3.obj"])
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr(set_process, "COMMAND", [sys.executable, str(tmp_path / "worker.py")])
    monkeypatch.setattr(set_process.tempfile, "tempdir", str(tmp_path / "scratch"))
    monkeypatch.setenv("FAKE_LOG", str(made.log))
    monkeypatch.setenv("FAKE_SET", str(tmp_path / "stored"))
    return made


# --------------------------------------------------------------------------------------------- one run
def test_bad_sets_are_reported_and_do_not_stop_the_others(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(set_process, "GRACE", 0.5)
    good = [f"good/{i}" for i in range(6)]
    bench.add("crash", "killed", "hang", "stubborn", "silent", "refuse", "touching", "open", *good)
    assert bench.run("--timeout", "2", "--workers", "4") == 3
    assert sorted(bench.computed()) == sorted([name.split("/")[-1] for name in bench.status()])
    report = bench.report()
    assert list(report) == ["crash", *good, "hang", "killed", "open", "refuse", "silent", "stubborn", "touching"]
    wanted = {
        "crash": ("crashed", "its process ended with signal SIGSEGV"),
        "killed": ("crashed", "its process ended with signal SIGKILL; perhaps memory ran out"),
        "hang": ("timeout", "no result after the timeout of 2 s"),
        "stubborn": ("timeout", "no result after the timeout of 2 s"),
        "silent": ("failed", "its process ended with exit code 1 and no result (no luck)"),
        "refuse": ("refused", "the faces differ"),
        "touching": ("failed", "its files were written to while they were read; start again"),
    }
    for name, (status, reason) in wanted.items():
        assert (report[name]["status"], report[name]["reason"]) == (status, reason)
    for name in [*good, "open"]:
        line = report[name]
        assert line["status"] == "done" and line["seconds"] > 0 and line["keyframes"] == 3 and line["vertices"] == 164
        assert line["files"] == ["1.obj", "2.obj"] and line["parameters"]["n_modes"] == 30
        assert len(open_set(bench.out / line["output"])) == 3
    assert report["open"]["warnings"] == ["a bit open"]
    assert 1.9 < report["hang"]["seconds"] < 20
    assert "no luck" in report["silent"]["log"]
    # The summary says all of it, to somebody who did not watch.
    summary = bench.said[bench.said.index(next(line for line in bench.said if "have their bases" in line)) :]
    assert summary[0].startswith("7 of 14 sets have their bases; 14 were worked on now, in ")
    assert summary[1] == "7 have none:"
    for name, (status, reason) in wanted.items():
        assert any(line.startswith(f"  {status}") and f" {name}: {reason}" in line for line in summary)
    assert "  open: a bit open" in summary and summary[-1] == f"report: {bench.out / r.REPORT}"
    assert list((bench.root.parent / "scratch").iterdir()) == [], "temporary files are left"


def test_names_that_are_no_text(bench: Bench) -> None:
    """Names of files are bytes."""
    name = os.fsdecode(b"refuse-\xff\n")
    bench.add("a", name)
    assert bench.run() == 3
    assert bench.status() == {"a": "done", name: "refused"}
    assert bench.run("--retry") == 3 and "refuse" in bench.computed()[-1]


def test_each_set_has_a_line_with_the_rate_and_the_time_left(bench: Bench) -> None:
    bench.add("a", "b", "c")
    assert bench.run("--workers", "1") == 0
    assert bench.said[0] == f"3 sets of key-frames in {bench.root}"
    assert bench.said[1].startswith("[1/3] done a: 3 key-frames of 164 vertices, ")
    assert " sets a minute, 00:0" in bench.said[1] and bench.said[1].endswith(" left")
    assert bench.said[3].startswith("[3/3] done c: ") and "left" not in bench.said[3]
    assert bench.run("--quiet") == 0 and bench.said == []


def test_processes_have_one_thread_and_as_many_run_as_asked(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    together = []
    started, poll = set_process.SetProcess.__init__, set_process.SetProcess.poll
    alive: set[object] = set()

    def start(self: object, *args: object) -> None:
        started(self, *args)  # type: ignore[arg-type]
        alive.add(self)
        together.append(len(alive))

    def look(self: object) -> object:
        outcome = poll(self)  # type: ignore[arg-type]
        if outcome is not None:
            alive.discard(self)
        return outcome

    monkeypatch.setattr(set_process.SetProcess, "__init__", start)
    monkeypatch.setattr(set_process.SetProcess, "poll", look)
    bench.add(*(f"s{i}" for i in range(7)))
    assert bench.run("--workers", "3") == 0
    assert max(together) == 3
    assert {line.split()[2] for line in bench.log.read_text().splitlines()} == {"1"}


def test_workers_follow_the_machine_and_torchrun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LOCAL_WORLD_SIZE", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(12)), raising=False)
    assert default_workers() == 12
    for neighbours, n in (("4", 3), ("8", 1), ("100", 1)):
        monkeypatch.setenv("LOCAL_WORLD_SIZE", neighbours)
        assert default_workers() == n


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
    assert any("crashed  crash: its process ended with signal SIGSEGV" in line for line in bench.said)


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
    for file in (bench.out / "a" / "notes.txt", bench.out / "b"):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("mine")
    (bench.out / "c").mkdir()
    assert bench.run("--overwrite") == 3 and bench.computed() == ["c"]
    assert "also holds notes.txt" in bench.report()["a"]["reason"]
    assert "is no folder" in bench.report()["b"]["reason"]
    assert (bench.out / "a" / "notes.txt").read_text() == (bench.out / "b").read_text() == "mine"
    (bench.out / "a" / "notes.txt").unlink()
    (bench.out / "b").unlink()
    assert bench.run() == 0 and bench.computed() == ["a", "b"]


def test_what_was_derived_from_a_set_is_replaced_with_it(
    bench: Bench,
) -> None:
    """By the product's own way of writing."""
    code = f"""
        import json, sys
        sys.path.insert(0, {str(Path(tm.__file__).parents[1])!r})
        from torch_modal.data.stored import open_set, write_set
        job, source = json.load(open(sys.argv[1])), open_set({str(bench.root.parent / "stored")!r})
        write_set(job["folder"], source.keyframes, source.faces, source.bases, source.names)
        json.dump({{"status": "done", "keyframes": 3, "vertices": 164}}, open(sys.argv[2], "w"))
    """
    bench.log.with_name("worker.py").write_text(textwrap.dedent(code))
    bench.add("a")
    assert bench.run() == 0
    derived = bench.out / "a" / "between-0-1.safetensors"
    derived.write_text("made of the set")
    assert bench.run() == 0 and derived.exists()
    (bench.root / "a" / "1.obj").write_text("v 5 0 0")
    assert bench.run() == 0 and bench.report()["a"]["reason"] == "its files changed"
    assert not derived.exists() and len(open_set(bench.out / "a")) == 3


def test_a_foreign_report_is_not_replaced(bench: Bench) -> None:
    bench.add("a")
    bench.out.mkdir()
    (bench.out / r.REPORT).write_text("mine")
    assert bench.run() == 1
    assert "is no report of this command; --overwrite replaces it" in bench.said[0]
    assert (bench.out / r.REPORT).read_text() == "mine" and list(bench.out.iterdir()) == [bench.out / r.REPORT]
    assert bench.run("--overwrite") == 0 and list(bench.report()) == ["a"]


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


def test_leftovers_of_a_killed_write_are_removed(bench: Bench) -> None:
    bench.add("a")
    records = Records(bench.out)
    records.prepare()
    inputs = r.inputs_key([bench.root / "a" / "1.obj", bench.root / "a" / "2.obj"])
    parameters = review.Options().parameters()
    records.write(Record("a", r.STARTED, output="a", inputs=inputs, parameters=parameters, ours=True))
    for name in (".a.77-0123abcd.tmp", ".a.77-0123abcd.old.tmp", ".a.mine.tmp", ".b.77-0123abcd.tmp"):
        (bench.out / name).mkdir()
    assert bench.run() == 0
    assert bench.report()["a"]["reason"] == "it was interrupted"
    left = {path.name for path in bench.out.iterdir() if path.name.endswith(".tmp")}
    assert left == {".a.mine.tmp", ".b.77-0123abcd.tmp"}


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
    report = {line["set"]: line for line in map(json.loads, (out / r.REPORT).read_text().splitlines())}
    assert [line["status"] for line in report.values()] == ["refused", "done", "done", "refused"]
    assert "faces" in report["differs"]["reason"] and "b-000.obj" in report["differs"]["reason"]
    assert "have the same name" in report["twice"]["reason"]
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


def test_a_set_is_done_when_its_bases_are_there(capsule: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    """Not when somebody notices: the command may be killed between the two."""
    files = save_frames(np.stack([capsule[0], 1.1 * capsule[0]]), capsule[1], tmp_path / "a", fmt="obj")
    records = Records(tmp_path / "out")
    records.prepare()
    record = Record("a", r.STARTED, "its files changed", output="a", inputs="1", ours=True)
    records.write(record)
    job = {"files": list(map(str, files)), "folder": str(tmp_path / "out" / "a"), "record_file": str(records.file("a"))}
    options = {"n_modes": 4, "mesher": "lattice", "cache": False}
    process = set_process.SetProcess({**job, "options": options, "record": asdict(record)}, 100.0)
    try:
        _wait_until(lambda: records.read("a").status == r.DONE)  # type: ignore[union-attr]
        assert len(open_set(tmp_path / "out" / "a")) == 2
        found = records.read("a")
        assert found is not None and found.finished
        assert replace(found, finished="") == replace(record, status=r.DONE, keyframes=2, vertices=len(capsule[0]))
    finally:
        process.close()


def test_worker_says_what_is_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each kind of error in the process of a set, and what the report calls it."""

    def outcome(error: Exception) -> dict:
        def compute(job: dict, found: dict) -> None:
            found["vertices"] = 7
            raise error

        monkeypatch.setattr(_set_worker, "_compute", compute)
        job, result = tmp_path / "job.json", tmp_path / "result.json"
        job.write_text('{"timeout": 100}')
        _set_worker.main(str(job), str(result))
        return json.loads(result.read_text())

    monkeypatch.setattr(_set_worker, "_end_with_parent", lambda: None)
    monkeypatch.setattr(_set_worker.faulthandler, "dump_traceback_later", lambda *_, **__: None)
    monkeypatch.setattr(_set_worker.faulthandler, "enable", lambda: None)
    handler = signal.getsignal(signal.SIGINT)
    try:
        assert outcome(tm.MeshError("it is\nflat")) == {
            "status": "refused",
            "vertices": 7,
            "reason": "it is flat",
            "warnings": [],
        }
        assert outcome(RuntimeError("no tetrahedra"))["status"] == "failed"
        assert outcome(MemoryError())["reason"] == "MemoryError:"
        assert outcome(FileExistsError(17, "there", "x"))["reason"] == "FileExistsError: [Errno 17] there: 'x'"
        bug = outcome(KeyError("k"))
        assert (bug["status"], bug["reason"]) == ("failed", "KeyError: 'k'") and "Traceback" in bug["log"]
    finally:
        signal.signal(signal.SIGINT, handler)


def _processes(mark: str) -> list[str]:
    """Command lines of running processes that work in a folder."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if mark in command:
            found.append(command)
    return found


def _wait_until(holds: Callable[[], bool], seconds: float = 100.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="looks for processes in /proc")
@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL], ids=lambda s: s.name)
def test_when_the_command_ends_so_do_its_processes(
    ending: signal.Signals, capsule: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    """Ctrl-C, the request of a batch system, and the one that no process can answer, while the mesher runs."""
    root, out, scratch = tmp_path / "shapes", tmp_path / "out", tmp_path / "scratch"
    scratch.mkdir()
    (tmp_path / "path").mkdir()
    # A mesher that hangs: the first pytetwild that the interpreter of the mesher's process finds.
    (tmp_path / "path" / "pytetwild.py").write_text(
        textwrap.dedent("""
        import time
        def tetrahedralize(*_, **__):
            time.sleep(100)
        """)
    )
    for name in ("a", "b"):
        save_frames(np.stack([capsule[0], 1.1 * capsule[0]]), capsule[1], root / name)
    search = os.pathsep.join([str(tmp_path / "path"), str(Path(tm.__file__).parents[1])])
    process = subprocess.Popen(
        [sys.executable, "-m", "torch_modal", "precompute", str(root), "--out", str(out), "--workers", "1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(scratch), "PYTHONPATH": search},
        preexec_fn=listen_to_ctrl_c,
    )
    try:
        _wait_until(lambda: any("_tetwild_worker" in line for line in _processes(str(scratch))))
        process.send_signal(ending)
        said = process.communicate(timeout=60)[1]
    finally:
        process.kill()
    _wait_until(lambda: not _processes(str(scratch)), 20)
    assert not list(out.rglob(BASES_FILE))
    if ending == signal.SIGKILL:
        assert Records(out).read("a").status == r.STARTED  # type: ignore[union-attr]
        return
    assert process.returncode == 130
    assert said == "torch-modal: interrupted\n"
    assert list(scratch.iterdir()) == []
    lines = [json.loads(line) for line in (out / r.REPORT).read_text().splitlines()]
    assert [(line["set"], line["status"]) for line in lines] == [("a", "unfinished"), ("b", "unfinished")]


# --------------------------------------------------------------------------------------------- what is shown
def test_the_bar_is_for_terminals_and_leaves_lines_to_failures(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    progress = Progress(10, said.append, bar=True)
    try:
        progress.settled(Record("a", r.DONE, seconds=1.0), Counts(1, 0, 0))
        assert said == []
        progress.settled(Record("b", r.CRASHED, "its process ended", seconds=1.0), Counts(5, 3, 1))
        progress.settled(Record("c", r.DONE, "its files changed", keyframes=2, vertices=9), Counts(6, 3, 1))
        assert said == [
            "[5/10] crashed b: its process ended, 1.0 s",
            "[6/10] done c (its files changed): 2 key-frames of 9 vertices",
        ]
        progress._shown -= 10
        progress.show(lambda: Counts(6, 3, 1))
        # The rate counts the three sets of now, not those of an earlier run.
        assert (progress._bar.n, progress._bar.initial, progress._bar.total) == (6, 3, 10)
    finally:
        progress.close()


def test_names_that_no_terminal_shows() -> None:
    assert printable("a/ü") == "a/ü"
    assert printable("a\nb") == "'a\\nb'"
    assert printable("\udcff") == "\\udcff"
