"""The child process that runs pytetwild: ``python _tetwild_worker.py JOB.npz RESULT.npz``.

A script, never imported by the package: pytetwild may crash, hang, hold the GIL or replace signal handlers,
and it does all that here. It imports no torch and nothing of torch_modal, so that it starts in well under a second.
"""

import sys

# A script's folder comes first on the path, where modules of this package would shadow modules of libraries.
del sys.path[0]

import ctypes  # noqa: E402
import signal  # noqa: E402
import traceback  # noqa: E402
import types  # noqa: E402

import numpy as np  # noqa: E402

MESHER_RAISED = 3
"""Exit code; also in tetwild.py, which this script cannot import."""


def main(job_path: str, result_path: str) -> None:
    """Decimate the surface, fill it with tetrahedra, write ``vertices (N, 3)`` and ``tets (T, 4)``.

    The job holds ``vertices (V, 3)`` centred with a bounding-box diagonal of 100, ``faces (F, 3)`` and the
    scalars ``edge_length_fac``, ``epsilon``, ``stop_energy``, ``max_surface_faces``, ``timeout``, ``processor_time``.
    """
    with np.load(job_path) as job:
        vertices, faces = job["vertices"].copy(), job["faces"].astype(np.int32)
        names = ("edge_length_fac", "epsilon", "stop_energy", "timeout", "processor_time")
        edge_length_fac, epsilon, stop_energy, timeout, processor_time = (float(job[name]) for name in names)
        max_surface_faces = int(job["max_surface_faces"])

    if hasattr(signal, "alarm"):
        # The parent enforces the timeout. If the parent is killed, the default action of SIGALRM ends this process
        # even while pytetwild holds the GIL.
        signal.alarm(int(min(timeout + 10, 2**31 - 1)))

    if processor_time < sys.maxsize and sys.platform != "win32":
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (max(int(processor_time), 1), int(processor_time) + 2))  # SIGXCPU

    if sys.platform == "linux":
        pr_set_pdeathsig = 1  # ends this process together with its parent
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)

    if len(faces) > max_surface_faces:
        import fast_simplification  # after the alarm is set

        # agg=7 are the quadrics' absolute thresholds, right for a diagonal of 100.
        vertices, faces = fast_simplification.simplify(
            np.ascontiguousarray(vertices), faces, target_count=max_surface_faces, agg=7
        )

    # pyvista serves only a plotting accessor: without it, start-up takes half the time and needs no display libraries.
    sys.modules["pyvista"] = types.ModuleType("pyvista")
    try:
        from pytetwild import tetrahedralize
    except (ImportError, AttributeError):  # a version that needs more of it
        for name in [name for name in sys.modules if name.split(".")[0] in ("pyvista", "pytetwild")]:
            del sys.modules[name]
        from pytetwild import tetrahedralize

    try:
        points, tets = tetrahedralize(
            np.ascontiguousarray(vertices, dtype=np.float64),
            np.ascontiguousarray(faces, dtype=np.int32),
            edge_length_fac=edge_length_fac,
            epsilon=epsilon,
            stop_energy=stop_energy,
            num_threads=1,  # more make it no faster
        )
    except (RuntimeError, ValueError) as error:
        # Failures of the mesher last, but not failures for lack of libraries, memory or threads.
        traceback.print_exc()
        sys.exit(1 if any(word in str(error) for word in ("alloc", "memory", "Resource")) else MESHER_RAISED)
    np.savez(result_path, vertices=np.asarray(points, np.float64), tets=np.asarray(tets, np.int64))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
