"""Processes of folder trees: two commands at once, their ends, a Dask cluster."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from conftest import listen_to_ctrl_c, processes, wait_until
from safetensors.torch import load_file

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.data.precompute import DONE, Options, precompute_tree, run_set
from torch_modal.data.stored import SET_FILE, StoredSet, find_sets
from torch_modal.io.write import save_mesh

OPTIONS = Options(n_modes=4, mesher="lattice")  # the lattice always gives the same tetrahedra
ARGUMENTS = ["--modes", "4", "--mesher", "lattice"]


def make_tree(root: Path, n_sets: int) -> Path:
    """Sets of two slender bars, for which a lattice has few cubes."""
    bar = trimesh.creation.box((10.0, 1.0, 1.0)).subdivide()
    vertices, faces = np.array(bar.vertices), np.array(bar.faces, dtype=np.int64)
    for i in range(n_sets):
        poses = np.stack([vertices, vertices * (1.0 + 0.01 * i, 1.1, 1.0)])
        save_mesh(poses, faces, root / f"group{i % 3}" / f"s{i}", stem="key")
    return root


def tensors(out: Path) -> dict[str, dict[str, torch.Tensor]]:
    """Everything that is stored, by place and name."""
    found = {str(at.relative_to(out)): load_file(at / SET_FILE) for at in find_sets(out)}
    for own in found.values():
        del own["digests"]  # with that of the note, which has the time that it took
    return found


def start(root: Path, out: Path, *options: str) -> "subprocess.Popen[str]":
    """The command in a process of its own."""
    search = os.pathsep.join([os.environ.get("PYTHONPATH", ""), str(Path(tm.__file__).parents[1])]).lstrip(os.pathsep)
    return subprocess.Popen(
        [sys.executable, "-m", "torch_modal", "precompute", str(root), "--out", str(out), *ARGUMENTS, *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONPATH": search},
        preexec_fn=listen_to_ctrl_c,
    )


# --------------------------------------------------------------------------------------------- several commands
@pytest.mark.slow
def test_two_commands_on_one_output_folder_at_once(tmp_path: Path) -> None:
    root, out = make_tree(tmp_path / "shapes", 4), tmp_path / "out"
    both = [start(root, out, "--workers", "2") for _ in range(2)]
    said = [one.communicate(timeout=300)[0] for one in both]
    assert [one.returncode for one in both] == [0, 0], said
    assert all("4 of 4 sets have their bases" in text for text in said)
    assert all(len(StoredSet(folder).bases) == 2 for folder in find_sets(out)) and len(find_sets(out)) == 4
    assert not list(out.rglob(".*"))
    said = []  # the results are current, whoever's they are
    precompute_tree(root, out, OPTIONS, workers=2, say=said.append)
    assert "4 of 4 sets have their bases; 0 were worked on now" in said[1]


def test_a_machine_without_the_output_folder_is_named(tmp_path: Path) -> None:
    root = make_tree(tmp_path / "shapes", 1)
    with pytest.raises(FileNotFoundError, match=r"has no folder .*; all machines need the same folders"):
        run_set(root, tmp_path / "nowhere", "group0/s0", OPTIONS)


# --------------------------------------------------------------------------------------------- the end
@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where processes that are started have their temporary files; their mesher hangs, as it is not pytetwild's."""
    if not Path("/proc/self/cmdline").exists():
        pytest.skip("looks for processes in /proc")
    (tmp_path / "path").mkdir()
    (tmp_path / "path" / "pytetwild.py").write_text("import time\ntetrahedralize = lambda *_, **__: time.sleep(100)\n")
    search = os.pathsep.join([str(tmp_path / "path"), str(Path(tm.__file__).parents[1])])
    monkeypatch.setenv("PYTHONPATH", search)
    (tmp_path / "scratch").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "scratch"))
    return tmp_path / "scratch"


def n_meshers(scratch: Path) -> int:
    return sum("_tetwild_worker" in line for line in processes(str(scratch)).values())


@pytest.mark.parametrize(
    "ending",
    [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow), signal.SIGKILL],
    ids=["SIGINT", "SIGTERM", "SIGKILL"],
)
def test_when_the_command_ends_so_do_its_processes(ending: signal.Signals, scratch: Path, tmp_path: Path) -> None:
    """Ctrl-C, the request of a batch system, and the one that no process can answer, while the mesher runs."""
    root, out = make_tree(tmp_path / "shapes", 2), tmp_path / "out"
    command = start(root, out, "--mesher", "tetwild", "--workers", "1")
    try:
        wait_until(lambda: n_meshers(scratch) == 1)
        command.send_signal(ending)
        said = command.communicate(timeout=60)[0]
    finally:
        command.kill()
    wait_until(lambda: not processes(str(scratch)), 120)
    assert not find_sets(out)
    if ending != signal.SIGKILL:
        assert command.returncode == 130 and said.endswith("torch-modal: interrupted\n")
        assert list(scratch.iterdir()) == []
        assert not [path for path in out.rglob("*") if path.is_file()]


# --------------------------------------------------------------------------------------------- Dask
@pytest.fixture
def cluster(scratch: Path) -> Iterator[Any]:
    """Two worker processes of a thread each."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as made:
        yield made


@pytest.mark.slow
def test_cluster_does_all_sets_though_a_worker_is_killed(cluster: Any, scratch: Path, tmp_path: Path) -> None:
    root, expected, out = make_tree(tmp_path / "shapes", 6), tmp_path / "expected", tmp_path / "out"
    assert {record.status for record in precompute_tree(root, expected, OPTIONS).values()} == {DONE}
    first = {worker.process.pid for worker in cluster.workers.values()}

    def kill() -> None:
        wait_until(lambda: out.is_dir() and find_sets(out), 600)
        wait_until(lambda: processes(str(scratch)))
        os.kill(min(first), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    records = precompute_tree(root, out, OPTIONS, scheduler=cluster.scheduler_address)
    killer.join()
    assert {worker.process.pid for worker in cluster.workers.values()} != first
    assert [record.status for record in records.values()] == [DONE] * 6
    torch.testing.assert_close(tensors(out), tensors(expected), rtol=0, atol=0)
    wait_until(lambda: not processes(str(scratch)))


@pytest.mark.slow
def test_ctrl_c_ends_the_sets_on_a_cluster_and_leaves_the_cluster(cluster: Any, scratch: Path, tmp_path: Path) -> None:
    root, out = make_tree(tmp_path / "shapes", 3), tmp_path / "out"
    command = start(root, out, "--mesher", "tetwild", "--scheduler", cluster.scheduler_address)
    try:
        wait_until(lambda: n_meshers(scratch) == 2)
        command.send_signal(signal.SIGINT)
        said = command.communicate(timeout=60)[0]
    finally:
        command.kill()
    assert command.returncode == 130 and "torch-modal: interrupted" in said, said
    wait_until(lambda: not processes(str(scratch)), 120)
    assert not find_sets(out)
    records = precompute_tree(root, out, OPTIONS, scheduler=cluster.scheduler_address)
    assert {record.status for record in records.values()} == {DONE}


def test_a_cluster_that_is_not_there_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dask = pytest.importorskip("dask")
    make_tree(tmp_path / "shapes", 1)
    argv = ["precompute", str(tmp_path / "shapes"), "--out", str(tmp_path / "out"), "--scheduler", "tcp://127.0.0.1:1"]
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        assert cli.main(argv) == 1
    assert "127.0.0.1:1" in capsys.readouterr().err
