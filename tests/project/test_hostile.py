"""Hostile input, each in its own process: an error that reads well, or a right result; never a signal or a hang."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from conftest import listen_to_ctrl_c
from hostile_inputs import CASES, EITHER, ERROR
from torch.utils.data import DataLoader, Dataset

import torch_modal as tm
from torch_modal.threads import n_threads

ROOT = Path(tm.__file__).parents[1]
TESTS = Path(__file__).parents[1]
IN_EVERY_RUN = ("nan", "half-flipped")
POSIX = pytest.mark.skipif(not hasattr(os, "killpg"), reason="process groups are POSIX")


def environment(cache: Path | None = None) -> dict[str, str]:
    path = os.pathsep.join([str(ROOT), str(TESTS)])
    return {**os.environ, "PYTHONPATH": path, **({} if cache is None else {"TORCH_MODAL_CACHE": str(cache)})}


@pytest.mark.parametrize(
    "name", [name if name in IN_EVERY_RUN else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
def test_error_or_right_result(name: str, tmp_path: Path) -> None:
    command = [sys.executable, str(TESTS / "hostile_inputs.py"), name]
    run = subprocess.run(command, capture_output=True, text=True, timeout=240, cwd=tmp_path, env=environment())
    assert run.returncode == 0, run.stderr
    said, wanted = run.stdout.strip(), CASES[name][2]
    if wanted == EITHER:
        assert said == "right" or said.startswith("error: "), said
    else:
        assert said.startswith("error: " if wanted == ERROR else "right"), said
    if said.startswith("error: "):
        assert len(said.splitlines()) == 1 and 40 < len(said) < 700, said
    assert list(tmp_path.iterdir()) == [], "nothing is left in the working folder"


CALL = """
import sys, numpy as np, torch_modal as tm
from hostile_inputs import capsule
v, f = capsule()
for basis in tm.extract_bases(np.stack([v, v * (1, 1, 1.2)]), f, 10, mesher="tetwild"):
    print(basis.eigenvalues.sum().item())
"""


FINE = CALL.replace('"tetwild"', "tm.TetWild(0.02, 1e-3, 10.0, 10_000)")
EACH = """
import torch_modal as tm
from torch_modal.modes import carrying
carrying.MAX_FIT = -1  # no tetrahedra are carried

class OneByLattice:
    calls = 0
    def key(self):
        return {"mesher": "one by lattice"}
    def fill(self, surface, stop):
        self.calls += 1
        mesher = tm.Lattice() if self.calls == 1 else tm.TetWild(0.02, 1e-3, 10.0, 10_000)
        return mesher.fill(surface, stop)
""" + CALL.replace("[v, v", "[v, v * (1, 1, 1.1), v").replace('"tetwild"', "OneByLattice()")


def start(cache: Path, code: str = CALL) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(cache),
        preexec_fn=listen_to_ctrl_c if os.name == "posix" else None,
    )


def workers_of(pid: int) -> list[int]:
    """Children of a process that run the mesher."""
    found = []
    for folder in Path("/proc").iterdir():
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == pid and b"_tetwild_worker" in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
        except (OSError, ValueError, IndexError):
            continue
    return found


@pytest.fixture
def running(tmp_path: Path) -> Iterator[tuple["subprocess.Popen[str]", int]]:
    """A process in the middle of meshing, and its worker."""
    if not Path("/proc/self/stat").exists():
        pytest.skip("workers are found through /proc, which this system does not have")
    process = start(tmp_path / "cache", FINE)
    try:
        end = time.monotonic() + 60
        while not (workers := workers_of(process.pid)):
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.01)
        yield process, workers[0]
    finally:
        process.kill()
        process.communicate()


@POSIX
def test_a_killed_worker_is_an_error_that_says_so(running: tuple["subprocess.Popen[str]", int], tmp_path: Path) -> None:
    process, worker = running
    os.kill(worker, signal.SIGKILL)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "signal SIGKILL" in errors.splitlines()[-1]
    assert "key-frame" in errors.splitlines()[-1]
    assert len(list((tmp_path / "cache").glob("*.safetensors"))) == 0


@POSIX
def test_ctrl_c_ends_all_of_several_workers(tmp_path: Path) -> None:
    if not Path("/proc/self/stat").exists():
        pytest.skip("workers are found through /proc, which this system does not have")
    process = start(tmp_path / "cache", EACH)
    try:
        end = time.monotonic() + 60
        while len(workers := workers_of(process.pid)) < min(2, n_threads()):
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
        process.communicate()
    assert errors.splitlines()[-1] == "KeyboardInterrupt"
    assert not any(Path(f"/proc/{worker}").exists() for worker in workers)
    assert len(list((tmp_path / "cache").glob("*.safetensors"))) <= 2, errors  # those of the first key-frame


class Bars(Dataset):  # type: ignore[type-arg]
    """Bases made inside of data-loader workers."""

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: int) -> torch.Tensor:
        from hostile_inputs import capsule

        vertices, faces = capsule()
        return tm.extract_modes(vertices * (1, 1, 1 + index), faces, 5, mesher="tetwild", cache=False).eigenvalues


@pytest.mark.slow
def test_usable_from_dataloader_workers_and_threads() -> None:
    found = list(DataLoader(Bars(), batch_size=1, num_workers=2, timeout=200))
    assert all(torch.isfinite(values).all() for values in found)
    results: dict[int, torch.Tensor] = {}
    threads = [threading.Thread(target=lambda i=i: results.update({i: Bars()[i]})) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for index in range(2):
        torch.testing.assert_close(results[index], found[index][0], rtol=0.2, atol=0)
