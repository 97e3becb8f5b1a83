"""Two agents of torchrun share a folder tree; one is killed, and the same command goes on where they stopped."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

import torch_modal as tm
from torch_modal.bulk import records as r
from torch_modal.data.stored import BASES_FILE, find_sets, open_set
from torch_modal.io.write import save_frames

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="looks for processes in /proc"),
]

# What the mesher's process imports: the first pytetwild on its path. It fills convex bodies (a tetrahedron from the
# centre to each face), crashes on those of one number of vertices, hangs on another, and writes down what it was given.
FAKE_MESHER = """
import os, signal, time
import numpy as np

def tetrahedralize(vertices, faces, **_):
    shape = np.ptp(vertices, axis=0) / np.ptp(vertices)
    with open(os.environ["FAKE_LOG"], "a") as log:
        log.write("%d %s\\n" % (len(vertices), np.round(np.sort(shape), 4).tolist()))
    if len(vertices) == CRASH:
        os.kill(os.getpid(), signal.SIGSEGV)
    while len(vertices) == HANG:
        time.sleep(1)
    centre = np.full((len(faces), 1), len(vertices))
    return np.concatenate([vertices, np.zeros((1, 3))]), np.concatenate([centre, faces], axis=1)
"""
GOOD, CRASH, HANG = 10, 6, 8


def ellipsoid(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A sphere whose number of vertices tells what the mesher does with it."""
    ball = trimesh.creation.uv_sphere(radius=1.0, count=(n, n))
    ball.merge_vertices()
    return np.array(ball.vertices), np.array(ball.faces, dtype=np.int64)


class Cluster:
    """Agents of torchrun on this machine that run the command on one tree."""

    def __init__(self, folder: Path, n_sets: int, backend: str) -> None:
        self.root, self.out, self.log = folder / "shapes", folder / "out", folder / "meshed"
        self.scratch, self._path, self._backend, self._folder = folder / "scratch", folder / "path", backend, folder
        for made in (self.scratch, self._path):
            made.mkdir()
        code = FAKE_MESHER.replace("CRASH", str(len(ellipsoid(CRASH)[0]))).replace("HANG", str(len(ellipsoid(HANG)[0])))
        (self._path / "pytetwild.py").write_text(code)
        for i in range(n_sets):
            kind = {3: CRASH, 5: HANG}.get(i, GOOD)
            vertices, faces = ellipsoid(kind)
            long = vertices * (1.0, 1.3, 1.6 + 0.03 * i)
            wide = vertices * (1.1, 1.5, 1.6 + 0.03 * i)
            save_frames(np.stack([long, wide]), faces, self.root / f"group{i % 3}" / f"s{i}", stem="key")
        self.agents: list[subprocess.Popen[bytes]] = []
        self._n_starts = 0

    def start(self) -> None:
        """Start two agents, each with one process that works on one set at a time."""
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self._n_starts += 1
        search = os.pathsep.join([str(self._path), str(Path(tm.__file__).parents[1])])
        environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("TORCHELASTIC")},
            "PYTHONPATH": search,
            "TMPDIR": str(self.scratch),
            "FAKE_LOG": str(self.log),
        }
        self.agents = []
        for rank in range(2):
            where = ["--node-rank", str(rank), "--master-addr", "127.0.0.1", "--master-port", str(port)]
            if self._backend == "c10d":
                where = ["--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{port}", "--rdzv-id", "x"]
                where += ["--rdzv-conf", f"is_host={int(rank == 0)}", "--local-addr", "127.0.0.1"]
            command = [sys.executable, "-m", "torch.distributed.run", "--nnodes", "2", "--nproc-per-node", "1", *where]
            command += ["-m", "torch_modal", "precompute", str(self.root), "--out", str(self.out)]
            command += ["--workers", "1", "--mesher", "tetwild", "--modes", "6", "--timeout", "60"]
            with self._said(rank).open("wb") as said:
                agent = subprocess.Popen(
                    command, stdout=said, stderr=subprocess.STDOUT, env=environment, start_new_session=True
                )
            self.agents.append(agent)

    def _said(self, rank: int) -> Path:
        return self._folder / f"said-{self._n_starts}-{rank}"

    def said(self, rank: int) -> str:
        return self._said(rank).read_text(errors="replace")

    def status(self) -> dict[str, dict]:
        """The report, by set."""
        lines = [json.loads(line) for line in (self.out / r.REPORT).read_text().splitlines()]
        return {line["set"]: line for line in lines}

    def done(self) -> dict[str, tuple[int, int]]:
        """Sets with bases, and the inode and time of the file."""
        if not self.out.is_dir():
            return {}
        stats = {folder: (folder / BASES_FILE).stat() for folder in find_sets(self.out)}
        return {str(folder): (stat.st_ino, stat.st_mtime_ns) for folder, stat in stats.items()}

    def meshed(self) -> Counter[str]:
        """How often the mesher was given each shape."""
        return Counter(self.log.read_text().splitlines()) if self.log.exists() else Counter()

    def processes(self) -> list[str]:
        """What runs on the tree or in its scratch folder, agents apart."""
        found = []
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            except OSError:
                continue
            if str(self._folder) in command and "torch.distributed.run" not in command:
                found.append(command)
        return found

    def wait_until(self, holds: Callable[[], bool], seconds: float) -> None:
        end = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < end, "".join(self.said(rank)[-3000:] for rank in range(2))
            time.sleep(0.1)

    def stop(self) -> None:
        for agent in self.agents:
            if agent.poll() is None:
                agent.send_signal(signal.SIGTERM)
        for agent in self.agents:
            try:
                agent.wait(40)
            except subprocess.TimeoutExpired:
                os.killpg(agent.pid, signal.SIGKILL)
                agent.wait()


@pytest.fixture
def cluster_of(tmp_path: Path) -> Iterator[Callable[[int, str], Cluster]]:
    made: list[Cluster] = []

    def make(n_sets: int, backend: str) -> Cluster:
        made.append(Cluster(tmp_path, n_sets, backend))
        return made[0]

    yield make
    for cluster in made:
        cluster.stop()


def kill(cluster: Cluster, rank: int) -> None:
    """End an agent and its process group as a machine that loses its power would."""
    os.killpg(cluster.agents[rank].pid, signal.SIGKILL)
    cluster.agents[rank].wait()


@pytest.mark.parametrize(("backend", "n_sets", "killed"), [("static", 40, 0), ("c10d", 14, 1)])
def test_kill_one_agent_and_start_again(
    cluster_of: Callable[[int, str], Cluster], backend: str, n_sets: int, killed: int
) -> None:
    cluster = cluster_of(n_sets, backend)
    cluster.start()
    cluster.wait_until(lambda: len(cluster.done()) >= n_sets * 2 // 5, 300)
    time.sleep(1.0)  # into the next sets
    kill(cluster, killed)
    # What the killed agent had started notices; the other agent brings its own work to an end by itself.
    cluster.wait_until(lambda: cluster.agents[1 - killed].poll() is not None, 300)
    cluster.wait_until(lambda: not cluster.processes(), 30)
    assert cluster.agents[1 - killed].returncode == 1
    if killed == 0:  # it hosted the store
        assert "Start the same command again to go on" in cluster.said(1)
        assert len(cluster.done()) < n_sets - 2
    else:
        # At most the one set that the dead process was at is missing; those that failed are known as well.
        left = Counter(line["status"] for line in cluster.status().values())
        assert left["failed"] == 2 and left["done"] >= n_sets - 3
        assert left["done"] + left[r.UNFINISHED] == n_sets - 2
        assert f"{left['done']} of {n_sets} sets have their bases" in cluster.said(0)
    before, meshed = cluster.done(), cluster.meshed()

    cluster.start()
    cluster.wait_until(lambda: all(agent.poll() is not None for agent in cluster.agents), 300)
    assert [agent.returncode for agent in cluster.agents] == [1, 1]  # torchrun's, where ours is 3
    assert "exitcode  : 3" in cluster.said(0)
    report = cluster.status()
    assert Counter(line["status"] for line in report.values()) == {"done": n_sets - 2, "failed": 2}
    assert "ended with signal SIGSEGV" in report["group0/s3"]["reason"]
    assert "no result after the timeout of 30 s" in report["group2/s5"]["reason"]
    assert report["group2/s5"]["seconds"] > 29
    said = cluster.said(0)
    assert f"{n_sets - 2} of {n_sets} sets have their bases" in said
    assert re.search(r"failed +group0/s3: .*SIGSEGV", said) and re.search(r"failed +group2/s5: .*timeout", said)
    assert "have their bases" not in cluster.said(1), "one process speaks for all"

    # Nothing that was done was touched, and nothing was computed twice but what was cut off.
    after = cluster.done()
    assert len(after) == n_sets - 2 and {name: after[name] for name in before} == before
    assert all(len(open_set(folder).bases) == 2 for folder in after)
    again = [shape for shape, n in cluster.meshed().items() if n > 1]
    assert len(cluster.meshed()) == n_sets
    assert len(again) <= 2 and max(cluster.meshed().values()) <= 2
    assert sum((cluster.meshed() - meshed).values()) <= n_sets - len(before) - (0 if killed == 0 else 2)
    assert cluster.processes() == [] and list(cluster.out.rglob(".*.tmp")) == []
