"""Where the sets of a folder tree are worked on: static shards, two commands at once, a Dask cluster."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
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
from torch_modal.data.batch.engines import Engine, dask_cluster, local_processes
from torch_modal.data.batch.precompute import Shard, precompute_tree
from torch_modal.data.batch.record import DONE, UNFINISHED
from torch_modal.data.batch.set_task import Options
from torch_modal.data.stored import BASES_FILE, KEYFRAMES_FILE, find_sets, open_set
from torch_modal.io.frames import save_frames

OPTIONS = Options(n_modes=4, mesher="lattice")  # the lattice always gives the same tetrahedra
ARGUMENTS = ["--modes", "4", "--mesher", "lattice"]
VARIABLES = (
    "SLURM_ARRAY_TASK_ID SLURM_ARRAY_TASK_MIN SLURM_ARRAY_TASK_COUNT RANK WORLD_SIZE TORCHELASTIC_RUN_ID".split()
)


def make_tree(root: Path, n_sets: int) -> Path:
    """Sets of two slender bars, for which a lattice has few cubes."""
    bar = trimesh.creation.box((10.0, 1.0, 1.0)).subdivide()
    vertices, faces = np.array(bar.vertices), np.array(bar.faces, dtype=np.int64)
    for i in range(n_sets):
        poses = np.stack([vertices, vertices * (1.0 + 0.01 * i, 1.1, 1.0)])
        save_frames(poses, faces, root / f"group{i % 3}" / f"s{i}", stem="key")
    return root


def tensors(out: Path) -> dict[str, dict[str, torch.Tensor]]:
    """Everything that is stored, by place and name."""
    files = (KEYFRAMES_FILE, BASES_FILE)
    return {str(at.relative_to(out)): load_file(at / files[0]) | load_file(at / files[1]) for at in find_sets(out)}


def start(root: Path, out: Path, *options: str, **environment: str) -> "subprocess.Popen[str]":
    """The command in a process of its own."""
    clean = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    search = os.pathsep.join([os.environ.get("PYTHONPATH", ""), str(Path(tm.__file__).parents[1])]).lstrip(os.pathsep)
    return subprocess.Popen(
        [sys.executable, "-m", "torch_modal", "precompute", str(root), "--out", str(out), *ARGUMENTS, *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**clean, "PYTHONPATH": search, **environment},
        preexec_fn=listen_to_ctrl_c,
    )


def report(out: Path, shard: Shard = Shard()) -> dict[str, str]:  # noqa: B008
    lines = [json.loads(line) for line in (out / shard.report).read_text().splitlines()]
    return {line["set"]: line["status"] for line in lines}


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)


# --------------------------------------------------------------------------------------------- shards
@pytest.mark.parametrize(
    ("options", "environment", "wanted"),
    [
        ([], {}, (1, 1)),
        (["--shard", "3/16"], {"RANK": "0", "WORLD_SIZE": "2"}, (3, 16)),
        ([], {"RANK": "1", "WORLD_SIZE": "4"}, (2, 4)),
        ([], {"SLURM_ARRAY_TASK_ID": "7", "SLURM_ARRAY_TASK_MIN": "5", "SLURM_ARRAY_TASK_COUNT": "3"}, (3, 3)),
        ([], {"SLURM_ARRAY_TASK_ID": "0", "SLURM_ARRAY_TASK_COUNT": "3", "RANK": "5", "WORLD_SIZE": "9"}, (1, 3)),
        (["--shard", "1/1"], {"SLURM_ARRAY_TASK_ID": "2", "SLURM_ARRAY_TASK_COUNT": "3"}, (1, 1)),
        ([], {"RANK": "4", "WORLD_SIZE": "4"}, None),
        (["--shard", "0/4"], {}, None),
        (["--shard", "5/4"], {}, None),
        (["--shard", "1/2", "--scheduler", "tcp://nowhere"], {}, None),
    ],
)
def test_shard_is_given_or_that_of_the_environment(
    options: list[str], environment: dict[str, str], wanted: tuple[int, int] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    seen = []

    def compute(*_: object, shard: Shard, **__: object) -> list[object]:
        seen.append(tuple(shard))
        return []

    monkeypatch.setattr("torch_modal.data.batch.precompute.precompute_tree", compute)
    if wanted is None:
        with pytest.raises(SystemExit):
            cli.main(["precompute", "shapes", "--out", "bases", *options])
    else:
        assert cli.main(["precompute", "shapes", "--out", "bases", *options]) == 0
    assert seen == ([] if wanted is None else [wanted])


class AtOnce(Executor):
    """Any executor will do: this one has the task done before it answers."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:  # type: ignore[type-arg]
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Elsewhere(AtOnce):
    """A worker whose package is another one than the command's."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:  # type: ignore[type-arg]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("torch_modal.data.batch.set_task.CACHE_VERSION", "another")
            return super().submit(fn, *args, **kwargs)


def test_shards_are_disjoint_and_errors_of_the_engine_are_told(tmp_path: Path) -> None:
    root, out, engine = make_tree(tmp_path / "shapes", 7), tmp_path / "out", Engine(Elsewhere())
    found = [precompute_tree(root, out, engine, OPTIONS, shard=Shard(number, 3)) for number in (1, 2, 3)]
    assert [len(records) for records in found] == [3, 2, 2]
    assert {record.set for records in found for record in records} == {f"group{i % 3}/s{i}" for i in range(7)}
    assert report(out, Shard(2, 3)) == {record.set: "failed" for record in found[1]}
    assert "has another version of torch_modal" in found[0][0].reason
    assert sorted(path.suffix for path in out.iterdir()) == [".jsonl"] * 3  # it is not held against the sets


def test_torchrun_is_not_told_of_bad_sets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would end the neighbours."""
    for i in (1, 2):
        (tmp_path / "shapes" / "a").mkdir(parents=True, exist_ok=True)
        (tmp_path / "shapes" / "a" / f"{i}.obj").write_text("")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a").write_text("in the way")
    argv = ["precompute", str(tmp_path / "shapes"), "--out", str(tmp_path / "out")]
    assert cli.main(argv) == 3
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "x")
    assert cli.main(argv) == 0


# --------------------------------------------------------------------------------------------- several commands
@pytest.mark.slow
def test_two_commands_on_one_output_folder_at_once(tmp_path: Path) -> None:
    root, out = make_tree(tmp_path / "shapes", 4), tmp_path / "out"
    both = [start(root, out, "--workers", "2") for _ in range(2)]
    said = [one.communicate(timeout=300)[0] for one in both]
    assert [one.returncode for one in both] == [0, 0], said
    assert all("4 of 4 sets have their bases" in text for text in said)
    assert list(report(out).values()) == [DONE] * 4
    assert all(len(open_set(folder).bases) == 2 for folder in find_sets(out)) and len(find_sets(out)) == 4
    assert not list(out.rglob(".*"))
    with local_processes(2) as engine:  # the results are current, whoever's they are
        said = []
        precompute_tree(root, out, engine, OPTIONS, say=said.append)
    assert "4 of 4 sets have their bases; 0 were worked on now" in said[1]


@pytest.fixture(scope="module")
def by_shards(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A tree of 40 sets, and their bases by local processes: four shards, each a command of its own."""
    folder = tmp_path_factory.mktemp("tree")
    root, out = make_tree(folder / "shapes", 40), folder / "out"
    shards = [
        start(root, out, "--workers", "1", SLURM_ARRAY_TASK_ID=str(i), SLURM_ARRAY_TASK_COUNT="4") for i in range(4)
    ]
    for i, shard in enumerate(shards):
        said = shard.communicate(timeout=1200)[0]
        assert shard.returncode == 0, said
        assert said.startswith(f"shard {i + 1}/4: 10 of 40 sets of key-frames in {root}\n")
        assert list(report(out, Shard(i + 1, 4)).values()) == [DONE] * 10
    return root, out


@pytest.mark.slow
def test_four_shards_do_all_sets(by_shards: tuple[Path, Path]) -> None:
    root, out = by_shards
    assert len(find_sets(out)) == 40
    with local_processes() as engine:
        records = precompute_tree(root, out, engine, OPTIONS, say=lambda _: None)
    assert {record.status for record in records} == {DONE} and len(records) == 40


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
    return sum("_tetwild_worker" in line for line in processes(str(scratch)))


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL], ids=lambda s: s.name)
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
    wait_until(lambda: not processes(str(scratch)), 30)
    assert not list(out.rglob(BASES_FILE))
    if ending != signal.SIGKILL:
        assert command.returncode == 130 and said.endswith("torch-modal: interrupted\n")
        assert list(scratch.iterdir()) == []
        assert list(report(out).values()) == [UNFINISHED] * 2


# --------------------------------------------------------------------------------------------- Dask
@pytest.fixture
def cluster(scratch: Path) -> Iterator[Any]:
    """Two worker processes of a thread each."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as made:
        yield made


@pytest.mark.slow
def test_cluster_does_all_sets_though_a_worker_is_killed(
    by_shards: tuple[Path, Path], cluster: Any, scratch: Path, tmp_path: Path
) -> None:
    root, expected = by_shards
    out, said = tmp_path / "out", []
    first = {worker.process.pid for worker in cluster.workers.values()}

    def kill() -> None:
        wait_until(lambda: out.is_dir() and len(find_sets(out)) >= 5, 600)
        wait_until(lambda: processes(str(scratch)))
        os.kill(min(first), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    with dask_cluster(cluster.scheduler_address) as engine:
        records = precompute_tree(root, out, engine, OPTIONS, say=said.append)
    killer.join()
    assert {worker.process.pid for worker in cluster.workers.values()} != first
    assert said[0].endswith(f"Dask cluster at {cluster.scheduler_address}, 2 sets at a time")
    assert [record.status for record in records] == [DONE] * 40
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
    assert set(report(out).values()) == {UNFINISHED}
    wait_until(lambda: not processes(str(scratch)), 30)
    assert not find_sets(out)
    with dask_cluster(cluster.scheduler_address) as engine:
        assert precompute_tree(root, out, engine, OPTIONS)[2].status == DONE


def test_a_cluster_that_is_not_there_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dask = pytest.importorskip("dask")
    make_tree(tmp_path / "shapes", 1)
    argv = ["precompute", str(tmp_path / "shapes"), "--out", str(tmp_path / "out"), "--scheduler", "tcp://127.0.0.1:1"]
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        assert cli.main(argv) == 1
    assert "127.0.0.1:1" in capsys.readouterr().err
