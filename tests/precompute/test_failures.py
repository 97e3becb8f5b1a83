"""A failure of the mesher is remembered, if it is the mesher's; nobody waits for it twice."""

import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from torch_modal.io.cache import cache_content
from torch_modal.precompute import tetwild
from torch_modal.precompute.extract import extract_modes
from torch_modal.precompute.tetrahedra import TetrahedralizationError
from torch_modal.precompute.tetwild import TetWild

Mesh = tuple[np.ndarray, np.ndarray]
COARSE = {"edge_length_fac": 0.08, "epsilon": 5e-3}


class Worker:
    """The script that runs in place of the mesher, and how often it did."""

    def __init__(self, folder: Path) -> None:
        self.script, self._runs = folder / "worker.py", folder / "runs"

    def does(self, code: str) -> None:
        self.script.write_text(
            f"import os, signal, sys, time\nopen({str(self._runs)!r}, 'a').write('x')\n" + textwrap.dedent(code)
        )

    @property
    def runs(self) -> int:
        return len(self._runs.read_text()) if self._runs.exists() else 0


@pytest.fixture
def worker(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Worker:
    made = Worker(tmp_path_factory.mktemp("worker"))
    monkeypatch.setattr(tetwild, "WORKER", made.script)
    return made


def modes_of(mesh: Mesh, folder: Path, **settings: float) -> object:
    return extract_modes(*mesh, 4, cache_dir=str(folder), method="solid", mesher=TetWild(**settings))  # type: ignore[arg-type]


CRASH = "os.kill(os.getpid(), signal.SIGSEGV)"


@pytest.mark.parametrize("code", [CRASH, "print('RuntimeError: no envelope'); sys.exit(3)"])
def test_a_crash_is_remembered(worker: Worker, capsule: Mesh, tmp_path: Path, code: str) -> None:
    worker.does(code)
    with pytest.raises(TetrahedralizationError) as first:
        modes_of(capsule, tmp_path)
    assert "earlier run" not in str(first.value)
    with pytest.raises(TetrahedralizationError) as second:
        modes_of(capsule, tmp_path, timeout=1e6)
    assert worker.runs == 1
    assert str(second.value).startswith(str(first.value))
    assert f"to try again, clear the cache in {tmp_path} (torch-modal cache --clear)" in str(second.value)


def test_a_timeout_is_remembered_up_to_its_length(worker: Worker, capsule: Mesh, tmp_path: Path) -> None:
    worker.does("time.sleep(60)")
    with pytest.raises(TetrahedralizationError, match=r"timeout of 1\.5 s"):
        modes_of(capsule, tmp_path, timeout=1.5)
    start = time.monotonic()
    for timeout in (1.5, 0.5):
        with pytest.raises(TetrahedralizationError, match=r"of 1.5 s.*give a timeout of more than 1.5 s, clear the"):
            modes_of(capsule, tmp_path, timeout=timeout)
    assert time.monotonic() - start < 1.5
    assert worker.runs == 1
    with pytest.raises(TetrahedralizationError, match="timeout of 2 s"):
        modes_of(capsule, tmp_path, timeout=2.0)
    assert worker.runs == 2
    with pytest.raises(TetrahedralizationError, match="more than 2 s"):
        modes_of(capsule, tmp_path, timeout=2.0)
    assert worker.runs == 2


@pytest.mark.parametrize(
    "code",
    [
        "os.kill(os.getpid(), signal.SIGKILL)",
        "sys.exit('ModuleNotFoundError: pytetwild')",
        "pass",
        "os.abort()",
        "os.kill(os.getpid(), signal.SIGBUS)",
    ],
    ids=["killed", "library missing", "no result", "aborted", "bus error"],
)
def test_what_is_not_the_meshers_fault_is_tried_again(worker: Worker, capsule: Mesh, tmp_path: Path, code: str) -> None:
    worker.does(code)
    for _ in range(2):
        with pytest.raises(TetrahedralizationError):
            modes_of(capsule, tmp_path)
    assert worker.runs == 2
    assert cache_content(tmp_path).n_entries == 0


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit of the address space")
def test_too_little_memory_is_not_remembered(worker: Worker, capsule: Mesh, tmp_path: Path) -> None:
    """The real mesher where threads and memory cannot be had, and then where they can."""
    real = str(Path(tetwild.__file__).with_name("_tetwild_worker.py"))
    limited = "import resource\nresource.setrlimit(resource.RLIMIT_AS, ({0}, {0}))\n"
    run = f"import runpy\nsys.path.insert(0, '')\nsys.argv[0] = {real!r}\nrunpy.run_path({real!r}, run_name='__main__')"
    worker.does(limited.format(180 * 2**20) + run)
    with pytest.raises(TetrahedralizationError, match=r"SIGABRT|exit code 1"):
        modes_of(capsule, tmp_path, **COARSE)
    assert cache_content(tmp_path).n_entries == 0
    worker.does(run)
    modes_of(capsule, tmp_path, **COARSE)
    assert worker.runs == 2


def test_another_version_of_the_mesher_is_tried(
    worker: Worker, capsule: Mesh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker.does(CRASH)
    for runs, installed in enumerate(("0.4.2", "0.4.3", "0.4.2")):
        monkeypatch.setattr(tetwild, "version", lambda _, installed=installed: installed)
        with pytest.raises(TetrahedralizationError, match="SIGSEGV"):
            modes_of(capsule, tmp_path)
        assert worker.runs == min(runs + 1, 2)


def test_success_after_a_failure_lasts(
    worker: Worker, capsule: Mesh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker.does("time.sleep(60)")
    with pytest.raises(TetrahedralizationError, match="timeout"):
        modes_of(capsule, tmp_path, timeout=0.5, **COARSE)
    monkeypatch.undo()
    modes_of(capsule, tmp_path, timeout=100.0, **COARSE)
    monkeypatch.setattr(tetwild, "WORKER", tmp_path / "gone")
    modes_of(capsule, tmp_path, timeout=0.5, **COARSE)  # the tetrahedra are kept: no failure stands before them


def test_the_exit_code_of_the_real_worker(capsule: Mesh, tmp_path: Path) -> None:
    """It tells the mesher's refusal, here of a wrong edge length, from a job that cannot be read."""
    numbers = {"edge_length_fac": 2.0, "epsilon": 1e-3, "stop_energy": 10.0, "max_surface_faces": 10**6, "timeout": 60}
    np.savez(tmp_path / "job.npz", vertices=capsule[0], faces=capsule[1], **numbers)
    for job, code, says in (("job.npz", tetwild.MESHER_RAISED, "ValueError: Edge"), ("none.npz", 1, "No such file")):
        command = [sys.executable, str(tetwild.WORKER), str(tmp_path / job), str(tmp_path / "result.npz")]
        run = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)
        assert run.returncode == code
        assert says in run.stderr.splitlines()[-1]
