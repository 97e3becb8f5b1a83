"""Weighted in-betweens of several key-frames (:class:`torch_modal.Blend`): error and time.

    python tests/benchmarks/weights.py [--modes 30]

Times are processor time on one thread, best of several, over one :class:`torch_modal.InBetween` of the same mesh in the
same run. Key-frames are the sample creature and, where the folder with larger meshes is there, frames of the closing
hand, for the times with triangles divided in four.
"""

import argparse
from collections.abc import Callable, Iterator

import torch
from cases import divided, keyframes_of
from measures import distance_and_edges
from timing import limit_threads, timed
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample

Row = tuple[str, str]


def middle(x: Tensor, faces: Tensor, bases: list[tm.ModalBasis]) -> Iterator[Row]:
    """The mean of all frames of the closing hand against the one in the middle."""
    w = torch.full((len(x),), 1 / len(x), dtype=torch.float64)

    def error(shape: Tensor) -> float:
        return distance_and_edges(shape, x[len(x) // 2], faces, 1)[1]

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
    x, faces = load_sample("creature")[:2]
    yield from times("creature", x, faces, tm.extract_bases(x, faces, n_modes))
    if found := keyframes_of("mh-hand-path"):
        x, faces = found
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
