"""The child process that runs pytetwild: ``python _tetwild_worker.py JOB.npz RESULT.npz``.

A script, never imported by the package: pytetwild may crash, hang, hold the GIL or replace signal handlers,
and it does all that here. It imports no torch and nothing of torch_modal, so that it starts in well under a second.
"""

import sys

# A script's folder comes first on the path, where modules of this package would shadow modules of libraries.
del sys.path[0]

import ctypes  # noqa: E402
import signal  # noqa: E402
import types  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402


def main(job_path: str, result_path: str) -> None:
    """Fill a surface with tetrahedra, write ``vertices (N, 3)`` and ``tets (T, 4)``.

    The job holds ``vertices (V, 3)``, ``faces (F, 3)`` and the scalars ``edge_length_fac``, ``epsilon``,
    ``stop_energy``, ``processor_time``.
    """
    with np.load(job_path) as job:
        surface = np.ascontiguousarray(job["vertices"]), np.ascontiguousarray(job["faces"].astype(np.int32))
        settings: dict[str, Any] = {name: float(job[name]) for name in ("edge_length_fac", "epsilon", "stop_energy")}
        processor_time = float(job["processor_time"])
    if processor_time < sys.maxsize and sys.platform != "win32":
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (max(int(processor_time), 1), int(processor_time) + 2))  # SIGXCPU
    if sys.platform == "linux":
        pr_set_pdeathsig = 1  # ends this process together with its parent
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)
    # pyvista serves only a plotting accessor: without it, start-up takes half the time and needs no display libraries.
    sys.modules["pyvista"] = types.ModuleType("pyvista")
    from pytetwild import tetrahedralize

    points, tets = tetrahedralize(*surface, **settings, num_threads=1)  # more threads make it no faster
    np.savez(result_path, vertices=np.asarray(points, np.float64), tets=np.asarray(tets, np.int64))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
