"""The ways to an in-between that are compared.

A method is a function of a case that gives the frames at the case's times, and how long one call for all of them took,
with everything that can be prepared beforehand left out. To add one, write the function under ``@method(name)``.
"""

import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from cases import HALF, Case
from full_space import full_space
from geodesic import geodesic
from reduced import ReducedPair, froehlich_botsch
from timing import timed

import torch_modal as tm
from torch_modal.geometry.rigid import blend

PEER_SECONDS = 180
MOST_VERTICES = 15_000  # over all vertices: more take minutes a step
# One thread, as for all others; with more, jax 0.10 waits for itself for ever on few cores and large meshes.
PEER_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
    "JAX_CPU_ENABLE_ASYNC_DISPATCH": "false",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
}


class Outcome(NamedTuple):
    """What a method gives."""

    frames: torch.Tensor
    """*Shape:* ``(T, V, 3)``."""
    seconds: float
    """Processor seconds of one call for all T; NaN where there is nothing to time."""
    note: str = ""
    """What a reader should know: that it did not converge, for instance."""
    making: float = float("nan")
    """Seconds of what is made once for a mesh, where that was timed."""


class Method(NamedTuple):
    """A way to in-betweens."""

    function: Callable[[Case], Outcome]
    half_only: bool
    """Whether it knows t = 1/2 alone."""


class UnavailableError(Exception):
    """This method cannot run here, or not on this case."""


METHODS: dict[str, Method] = {}


def method(name: str, half_only: bool = False) -> Callable[[Callable[[Case], Outcome]], Callable[[Case], Outcome]]:
    """Put a function into ``METHODS``."""

    def register(function: Callable[[Case], Outcome]) -> Callable[[Case], Outcome]:
        METHODS[name] = Method(function, half_only)
        return function

    return register


@method("truth")
def truth(case: Case) -> Outcome:
    """The true in-betweens themselves: what a perfect guess would show in each column."""
    if set(case.times) - set(case.truths):
        raise UnavailableError("no truth")
    return Outcome(torch.stack([case.truths[t] for t in case.times]), float("nan"))


@method("linear")
def linear(case: Case) -> Outcome:
    """Straight lines between the first key-frame and the second laid upon it; the rigid motion along its geodesic."""
    times = torch.tensor(case.times, dtype=case.x_a.dtype)
    weights = torch.ones(len(case.x_a), dtype=case.x_a.dtype)
    return Outcome(*timed(lambda: blend(case.x_a, case.x_b, times, weights)))


@method("paired", half_only=True)
def paired(case: Case) -> Outcome:
    """The paper's space, with the default mu: the preset "paper"."""
    layer = tm.MidShape(case.bases(30), case.faces, preset="paper")
    result, seconds = timed(lambda: layer.solve(case.x_a, case.x_b))
    return Outcome(result.shapes[None], seconds, convergence(result))


@method("joint")
def joint(case: Case) -> Outcome:
    """The modes added to the blend by local rotations: as "accurate" without its local steps."""
    return by_layer(case, 30, solver=tm.Solver(local_steps=0))


@method("fast")
def fast(case: Case) -> Outcome:
    """The preset "fast": the same on 300 coarse faces."""
    return by_layer(case, 30, preset="fast")


@method("subdivide")
def subdivide(case: Case) -> Outcome:
    """The preset "accurate", the default of ``subdivide``: the same, with steps on the fine mesh after it."""
    return by_layer(case, 30, preset="accurate")


@method("subdivide, polish 2")
def polished(case: Case) -> Outcome:
    """The same with two longer steps."""
    return by_layer(case, 30, solver=tm.Solver(polish=2))


@method("full", half_only=True)
def full(case: Case) -> Outcome:
    """The optimum over all vertices: the best of what a modal and a linear start lead to."""
    starts = InBetweens(case, 30, {"solver": tm.Solver()})()
    return by_full_space(
        case,
        lambda x_a, x_b, t, k: min(
            (full_space(x_a, x_b, case.faces, t, start=start) for start in (starts.shapes[k], None)),
            key=lambda result: result.energies[-1],
        ),
    )


@method("Froehlich-Botsch", half_only=True)
def example_based(case: Case) -> Outcome:
    """One reference with interpolated lengths and angles, on a decimated mesh, and back by deformation transfer."""
    reduced = ReducedPair(case.x_a, case.x_b, case.faces, 1000)
    return Outcome(*timed(lambda: torch.stack([froehlich_botsch(reduced, t) for t in case.times])))


@method("geodesic")
def isometric_geodesic(case: Case) -> Outcome:
    """As-isometric-as-possible (Kilian et al. 2007): eight steps, all optimised together, from coarse to fine."""
    begin = time.process_time()
    found = geodesic(case.x_a, case.x_b, case.faces)
    seconds = time.process_time() - begin
    return Outcome(found.at(torch.tensor(case.times, dtype=case.x_a.dtype)), seconds, f"{sum(found.iterations)} steps")


@method("morphomatics")
def differential_coordinates(case: Case) -> Outcome:
    """Differential coordinates with the first key-frame as the reference, as in the library's tutorial."""
    return by_peer(case)


class InBetweens:
    """A layer with these options, to be called for all times of a case."""

    def __init__(self, case: Case, n_modes: int, options: dict[str, Any]) -> None:
        self.case, self.times = case, torch.tensor(case.times, dtype=torch.float64)
        self.layer = tm.InBetween(case.bases(n_modes), case.faces, **options)

    def __call__(self) -> Any:
        with torch.no_grad():
            return self.layer.solve(self.case.x_a, self.case.x_b, self.times)


def by_layer(case: Case, n_modes: int, **options: Any) -> Outcome:
    """In-betweens by the layer with these options."""
    result, seconds = timed(InBetweens(case, n_modes, options))
    return Outcome(result.shapes, seconds, convergence(result))


def by_full_space(case: Case, solve: Callable[..., Any]) -> Outcome:
    """Over all vertices, once: it is too slow to be timed several times."""
    if len(case.x_a) > MOST_VERTICES:
        raise UnavailableError(f"{len(case.x_a)} vertices are too many")
    begin = time.process_time()
    results = [solve(case.x_a, case.x_b, t, k) for k, t in enumerate(case.times)]
    seconds = time.process_time() - begin
    notes = [f"{len(result.energies) - 1} steps" + ("" if result.stagnated else ", cut off") for result in results]
    return Outcome(torch.stack([result.shape for result in results]), seconds, notes[0])


def convergence(result: Any) -> str:
    """The number of steps where all went well, the statuses where not."""
    solution = result.solution
    if bool(solution.usable.all()):
        return f"{int(solution.n_steps.max())} steps"
    return f"not converged: statuses {sorted(set(solution.status.reshape(-1).tolist()))}"


def peer_python() -> str | None:
    """The interpreter that has the peers: ``TORCH_MODAL_PEER_PYTHON``, or this one if they are installed here."""
    given = os.environ.get("TORCH_MODAL_PEER_PYTHON")
    return given or (sys.executable if importlib.util.find_spec("morphomatics") else None)


def by_peer(case: Case, limit: float = PEER_SECONDS) -> Outcome:
    """In-betweens by morphomatics, in a child process: its threads and its memory are its own.

    No answer within the limit, in seconds, is an :class:`UnavailableError`.
    """
    python = peer_python()
    if python is None:
        raise UnavailableError("pip install morphomatics, or name a Python that has it with --peer-python")
    used = case.faces.unique()
    number = torch.full((len(case.x_a),), -1).index_put((used,), torch.arange(len(used)))
    with tempfile.TemporaryDirectory() as scratch:
        request, answer = Path(scratch) / "request.npz", Path(scratch) / "answer.npz"
        arrays = {"x_a": case.x_a[used].numpy(), "x_b": case.x_b[used].numpy(), "faces": number[case.faces].numpy()}
        np.savez(request, times=np.array(case.times), **arrays)
        command = [python, str(Path(__file__).with_name("peer_worker.py")), str(request), str(answer)]
        environment = {**os.environ, **PEER_ENVIRONMENT}
        environment.pop("PYTHONPATH", None)
        try:
            run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=limit)
        except subprocess.TimeoutExpired as error:
            raise UnavailableError(f"no answer in {limit:g} s") from error
        if run.returncode != 0:
            raise UnavailableError((run.stderr.strip() or f"exit code {run.returncode}").splitlines()[-1][:120])
        given = np.load(answer)
        frames = torch.from_numpy(given["frames"]).to(case.x_a.dtype)
    whole = torch.lerp(case.x_a, case.x_b, HALF).repeat(len(case.times), 1, 1)
    whole[:, used] = frames  # vertices of no face stay where they are
    return Outcome(whole, float(given["seconds"]), making=float(given["making"]))
