"""Hostile input, each in its own process: an error that reads well, or a right result; never a signal or a hang."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from conftest import listen_to_ctrl_c, processes, wait_until
from helpers.hostile_inputs import CASES, EITHER, ERROR
from torch.utils.data import DataLoader, Dataset

import torch_modal as tm
from torch_modal.threads import n_threads

ROOT = Path(tm.__file__).parents[1]
TESTS = Path(__file__).parents[1]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(TESTS)])}
IN_EVERY_RUN = ("nan", "half-flipped")


@pytest.mark.parametrize(
    "name", [name if name in IN_EVERY_RUN else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
def test_error_or_right_result(name: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "helpers.hostile_inputs", name]
    run = subprocess.run(command, capture_output=True, text=True, timeout=240, cwd=tmp_path, env=ENVIRONMENT)
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
from torch_modal.modes.lattice import Lattice
from torch_modal.modes.tetwild import TetWild
from helpers.hostile_inputs import capsule
v, f = capsule()
for basis in tm.extract_bases(np.stack([v, v * (1, 1, 1.2)]), f, 10, mesher="tetwild"):
    print(basis.eigenvalues.sum().item())
"""


FINE = CALL.replace('"tetwild"', "TetWild(0.02, 1e-3, 10.0, 10_000)")
EACH = """
from torch_modal.modes import carrying
carrying.MAX_FIT = -1  # no tetrahedra are carried

class OneByLattice:
    calls = 0
    def key(self):
        return {"mesher": "one by lattice"}
    def fill(self, surface, stop):
        self.calls += 1
        mesher = Lattice() if self.calls == 1 else TetWild(0.02, 1e-3, 10.0, 10_000)
        return mesher.fill(surface, stop)
""" + CALL.replace("[v, v", "[v, v * (1, 1, 1.1), v").replace('"tetwild"', "OneByLattice()")


@contextmanager
def meshing(folder: Path, code: str, n: int) -> Iterator[tuple["subprocess.Popen[str]", list[int]]]:
    """A process in the middle of meshing, and its workers, ``n`` or more."""
    if not Path("/proc/self/stat").exists():
        pytest.skip("workers are found through /proc, which this system does not have")
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**ENVIRONMENT, "TORCH_MODAL_CACHE": str(folder / "cache"), "TMPDIR": str(folder)},
        preexec_fn=listen_to_ctrl_c,
    )

    def workers() -> list[int]:
        return [pid for pid, command in processes(str(folder)).items() if "_tetwild_worker" in command]

    try:
        wait_until(lambda: len(workers()) >= n or process.poll() is not None)
        assert process.poll() is None
        yield process, workers()
    finally:
        process.kill()
        process.communicate()


def test_a_killed_worker_is_an_error_that_says_so(tmp_path: Path) -> None:
    with meshing(tmp_path, FINE, 1) as (process, workers):
        os.kill(workers[0], signal.SIGKILL)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "signal SIGKILL" in errors.splitlines()[-1] and "key-frame" in errors.splitlines()[-1]
    assert not list((tmp_path / "cache").glob("*.safetensors"))


def test_ctrl_c_ends_all_of_several_workers(tmp_path: Path) -> None:
    with meshing(tmp_path, EACH, min(2, n_threads())) as (process, _):
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert errors.splitlines()[-1] == "KeyboardInterrupt"
    assert not processes(str(tmp_path))
    assert len(list((tmp_path / "cache").glob("*.safetensors"))) <= 2, errors  # of the first key-frame


class Bars(Dataset):  # type: ignore[type-arg]
    """Bases made inside of data-loader workers."""

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: int) -> torch.Tensor:
        from helpers.hostile_inputs import capsule

        vertices, faces = capsule()
        return tm.extract_modes(vertices * (1, 1, 1 + index), faces, 5, mesher="tetwild", cache=False).eigenvalues


@pytest.mark.slow
def test_usable_from_dataloader_workers_and_threads() -> None:
    found = list(DataLoader(Bars(), batch_size=1, num_workers=2, timeout=200))
    assert all(torch.isfinite(values).all() for values in found)
    with ThreadPoolExecutor(2) as pool:
        for values, expected in zip(pool.map(Bars().__getitem__, range(2)), found, strict=True):
            torch.testing.assert_close(values, expected[0], rtol=0.2, atol=0)
