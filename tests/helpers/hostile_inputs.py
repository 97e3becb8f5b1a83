"""One hostile mesh through the whole pre-computation, in the process ``python -m helpers.hostile_inputs NAME``.

Prints ``error: TYPE: MESSAGE``, or ``right`` after checking what a right result has. Whatever else happens (a signal,
another exception, a NaN) fails the test that started it.
"""

import sys
import warnings

import numpy as np
import trimesh

Mesh = tuple[np.ndarray, np.ndarray]


def capsule() -> Mesh:
    mesh = trimesh.creation.capsule(height=3.0, radius=0.6, count=(10, 10))
    mesh.merge_vertices()
    return np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)


V, F = capsule()
BOX = trimesh.creation.box((1.0, 2.0, 3.0))
SPECK = trimesh.creation.icosphere(subdivisions=1, radius=0.4)


def changed(vertex: int, value: object) -> Mesh:
    points = V.copy()
    points[vertex] = value
    return points, F


def pieces(n: int) -> Mesh:
    places = [SPECK.vertices + np.array([i % 7, i // 7 % 7, i // 49]) for i in range(n)]
    return np.concatenate(places), np.concatenate([SPECK.faces + i * len(SPECK.vertices) for i in range(n)])


def with_fins() -> Mesh:
    fins = np.array([[F[0, 0], F[0, 1], len(V)], [F[40, 0], F[40, 1], len(V) + 1]])
    tips = [V[F[0]].mean(axis=0) * 1.5, V[F[40]].mean(axis=0) * 1.5]
    return np.concatenate([V, tips]), np.concatenate([F, fins])


ERROR, RIGHT, EITHER = "error", "right", "either"
CASES: dict[str, tuple[Mesh, int, str]] = {
    "nan": (changed(3, np.nan), 10, ERROR),
    "some points coincident": ((changed(3, V[4])[0], F), 10, RIGHT),
    "far from the origin": ((V + 1e6, F), 10, RIGHT),
    "flat": ((V * (1, 0, 1), F), 10, RIGHT),
    "paper-thin": ((V * (1, 1e-4, 1), F), 10, EITHER),
    "duplicate faces": ((V, np.concatenate([F, F[:30]])), 10, RIGHT),
    "degenerate faces": ((V, np.concatenate([F, F[:30][:, [0, 1, 1]]])), 10, RIGHT),
    "open": ((V, F[:-20]), 10, RIGHT),
    "two components": (pieces(2), 12, RIGHT),
    "twenty components": (pieces(20), 15, RIGHT),
    "ten components, many modes": (pieces(10), 70, RIGHT),
    "flipped": ((V, F[:, ::-1]), 10, RIGHT),
    "half-flipped": ((V, np.where(np.arange(len(F))[:, None] % 2 == 0, F, F[:, ::-1])), 10, RIGHT),
    "non-manifold fins": (with_fins(), 10, RIGHT),
    "box of 8 vertices, 50 modes": ((np.array(BOX.vertices), np.array(BOX.faces)), 50, ERROR),
    "box of 8 vertices, 18 modes": ((np.array(BOX.vertices), np.array(BOX.faces)), 18, RIGHT),
}


def main(name: str) -> None:
    """Run one case with two key-frames, so that carrying is part of it."""
    import torch

    import torch_modal as tm

    (vertices, faces), n_modes, _ = CASES[name]
    warnings.simplefilter("ignore")
    try:
        bases = tm.extract_bases(np.stack([vertices, vertices * 1.1]), faces, n_modes, cache=False)
    except (ValueError, RuntimeError) as error:
        print(f"error: {type(error).__name__}: {error}")
        return
    used = np.unique(faces)
    for basis in bases:
        assert torch.isfinite(basis.modes).all() and torch.isfinite(basis.eigenvalues).all()
        assert basis.modes.shape == (n_modes, len(vertices), 3)
        assert (basis.eigenvalues[1:] >= basis.eigenvalues[:-1]).all() and basis.eigenvalues[-1] > 0
        assert (basis.modes[:, used].abs().amax(dim=(1, 2)) > 0).all()
    torch.testing.assert_close(bases[0].eigenvalues[-1], 1.21 * bases[1].eigenvalues[-1], rtol=0.05, atol=0)
    print("right")


if __name__ == "__main__":
    main(sys.argv[1])
