"""Weighted in-betweens of several key-frames (:class:`torch_modal.Blend`): what must not change them, error, time.

    python tests/benchmarks/weights.py [--modes 30]

Differences are largest distances of vertices over the diagonal. Times are processor time on one thread, best of
several, over one :class:`torch_modal.InBetween` of the same mesh in the same run. Key-frames are the sample creature
and, where the folder with larger meshes is there, frames of the closing hand, for the times with triangles divided in
four.
"""

import argparse
from collections.abc import Callable, Iterator

import torch
from cases import DATA
from threads import limit_threads
from timing import timed
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.inbetween.settings import Preset

Row = tuple[str, str]


def far(x: Tensor, y: Tensor) -> float:
    """Largest distance over the diagonal. *Shape:* ``(V, 3)``."""
    return float((x - y).norm(dim=-1).max() / (y.amax(0) - y.amin(0)).norm())


def divided(x: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Shapes whose triangles are divided in four. *Shape:* ``(K, V, 3), (F, 3)``."""
    mesh = Connectivity(faces.numpy(), x.shape[1])
    i, j, k = faces.unbind(1)
    a, b, c = (torch.tensor(mesh.sides).view(3, -1) + x.shape[1]).unbind()  # of ij, jk, ki
    corners = ((i, a, c), (a, j, b), (c, b, k), (a, b, c))
    return torch.cat([x, x[:, mesh.edges].mean(2)], 1), torch.cat([torch.stack(face, 1) for face in corners])


def invariances(name: str, x: Tensor, faces: Tensor, bases: list[tm.ModalBasis], preset: Preset) -> Iterator[Row]:
    """What two key-frames, no weight, another order and the same twice change."""
    w = torch.tensor([0.7, 0.3], dtype=torch.float64)
    blend, between = tm.Blend(bases[:2], faces, preset), tm.InBetween(bases[:2], faces, preset)
    with torch.no_grad():
        one, slow = timed(lambda: between(x[0], x[1], 0.3))
        other, mine = timed(lambda: blend(x[:2], w))
    yield f"{name}, {preset}: two key-frames against InBetween; time", f"{far(other, one):.1e}; {mine / slow:.2f}"
    blend, n = tm.Blend(bases[:4], faces, preset), 4
    w, x = torch.tensor([0.4, 0.3, 0.2, 0.1], dtype=torch.float64), x[:n]
    with torch.no_grad():
        whole = blend(x, w)
        order = [2, 0, 3, 1]
        yield f"{name}, {preset}: another order", f"{far(blend(x[order], w[order]), whole):.1e}"
        twice = torch.tensor([0.4, 0.3, 0.15, 0.1, 0.05], dtype=torch.float64)
        yield f"{name}, {preset}: one twice", f"{far(blend(x[[0, 1, 2, 3, 2]], twice), whole):.1e}"
        for some in ([1, 3], [0, 1, 2]):
            own = torch.zeros(n, dtype=torch.float64)
            own[some] = w[some] / w[some].sum()
            found = far(blend(x, own), blend(x[some], own[some]))
            yield f"{name}, {preset}: others without weight, {len(some)} with", f"{found:.1e}"
        pair = tm.InBetween([bases[1], bases[3]], faces, preset)(x[1], x[3], 0.4)
        own = torch.tensor([0, 0.6, 0, 0.4], dtype=torch.float64)
        yield f"{name}, {preset}: an edge against InBetween of its two bases alone", f"{far(blend(x, own), pair):.1e}"


def gradients(name: str, x: Tensor, faces: Tensor, bases: list[tm.ModalBasis]) -> Iterator[Row]:
    """Against central differences along one direction."""
    blend = tm.Blend(bases, faces, solver=tm.Solver(tolerance=1e-11))
    generator = torch.Generator().manual_seed(0)
    w = torch.rand(len(x), generator=generator, dtype=torch.float64)
    given = x, w / w.sum()
    taken, to_x = (torch.randn(like.shape, generator=generator, dtype=torch.float64) for like in (x[0], x))
    to_w = torch.randn(len(x), generator=generator, dtype=torch.float64)
    leaves = [value.clone().requires_grad_() for value in given]
    (blend(*leaves) * taken).sum().backward()
    size = float((x[0].amax(0) - x[0].amin(0)).norm())
    moves = (1e-7 * size * to_x, 0 * w), (0 * x, 1e-5 * (to_w - to_w.mean()))
    for kind, leaf, move in zip(("key-frames", "weights"), leaves, moves, strict=True):
        with torch.no_grad():
            ends = [(blend(x + s * move[0], given[1] + s * move[1]) * taken).sum() for s in (1, -1)]
        expected = float(ends[0] - ends[1]) / 2
        assert leaf.grad is not None
        found = float((leaf.grad * move[kind == "weights"]).sum())
        yield f"{name}: gradient in {kind} against differences", f"{abs(found / expected - 1):.1e}"


def folds(name: str, x: Tensor, faces: Tensor, bases: list[tm.ModalBasis]) -> Iterator[Row]:
    """Statuses, and neighbouring triangles that lie on each other, of random weights; of the key-frames the most."""
    generator = torch.Generator().manual_seed(0)
    w = -torch.rand(20, len(x), generator=generator, dtype=torch.float64).log()
    with torch.no_grad():
        result = tm.Blend(bases, faces).solve(x, w / w.sum(1, keepdim=True))
    pairs = torch.tensor(Connectivity(faces.numpy(), x.shape[1]).face_neighbours)

    def of(shape: Tensor) -> int:
        a, b, c = shape[faces].unbind(1)
        normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
        return int(((normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(-1) < -0.9).sum())

    counts = torch.bincount(result.solution.status, minlength=5).tolist()
    found, most = sum(of(shape) for shape in result.shapes) / len(w), max(of(shape) for shape in x)
    yield f"{name}: 20 random weights: converged, fell back", f"{counts[0]}, {counts[4]}"
    yield f"{name}: folds of one, on average; of a key-frame, at most", f"{found:.1f}; {most}"


def middle(x: Tensor, faces: Tensor, bases: list[tm.ModalBasis]) -> Iterator[Row]:
    """The mean of all frames of the closing hand against the one in the middle."""
    w = torch.full((len(x),), 1 / len(x), dtype=torch.float64)
    edges = torch.tensor(Connectivity(faces.numpy(), x.shape[1]).edges)

    def error(shape: Tensor) -> float:
        lengths, true = ((one[edges[:, 0]] - one[edges[:, 1]]).norm(dim=-1) for one in (shape, x[len(x) // 2]))
        return float((lengths - true).abs().mean() / true.mean())

    with torch.no_grad():
        for preset in ("accurate", "fast"):
            found = error(tm.Blend(bases, faces, preset)(x, w))  # type: ignore[arg-type]
            yield f"hand, {preset}: edge error of the mean of nine over linear", f"{found / error(x.mean(0)):.2f}"


def times(name: str, x: Tensor, faces: Tensor, bases: list[tm.ModalBasis]) -> Iterator[Row]:
    """Of one weighted in-between of all key-frames, over that of one in-between of the first and the last."""
    w = torch.full((len(x),), 1 / len(x), dtype=torch.float64)
    half = torch.tensor(0.5, dtype=torch.float64)
    ends = bases[0], bases[-1]

    def trained(layer: torch.nn.Module, *given: Tensor) -> Callable[[], None]:
        return lambda: layer(*(v.clone().requires_grad_() for v in given)).square().sum().backward()

    for preset in ("accurate", "fast"):
        blend, between = tm.Blend(bases, faces, preset), tm.InBetween(ends, faces, preset)  # type: ignore[arg-type]
        with torch.no_grad():
            mine, one = timed(lambda: blend(x, w))[1], timed(lambda: between(x[0], x[-1], half))[1]  # noqa: B023
        back, back_one = timed(trained(blend, x, w))[1], timed(trained(between, x[0], x[-1], half))[1]
        label = f"{name}, {x.shape[1]:,} vertices, K = {len(x)}, {preset}: time over one in-between; with gradients"
        yield label, f"{mine / one:.1f}; {back / back_one:.1f}"


def rows(n_modes: int) -> Iterator[Row]:
    """All of them."""
    sample = load_sample("creature")
    x, faces = sample.keyframes, sample.faces
    bases = tm.extract_bases(x, faces, n_modes)
    yield from invariances("creature", x, faces, bases, "accurate")
    yield from invariances("creature", x, faces, bases, "fast")
    yield from gradients("creature", x, faces, bases)
    yield from folds("creature", x, faces, bases)
    yield from times("creature", x, faces, bases)
    if DATA.is_dir():
        x, faces = tm.load_keyframes([DATA / "mh-hand-path" / f"{i:02}.obj" for i in range(9)])
        yield from middle(x, faces, tm.extract_bases(x, faces, n_modes))
        x, faces = divided(x[:8], faces)
        yield from times("hand", x, faces, tm.extract_bases(x, faces, n_modes))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--modes", type=int, default=30, help="of each key-frame")
    arguments = parser.parse_args()
    limit_threads()
    for what, number in rows(arguments.modes):
        print(f"{what:<100}{number}", flush=True)


if __name__ == "__main__":
    main()
