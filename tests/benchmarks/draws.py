"""Draws of each random transform: volumes, edge strains, and how many pass through themselves anew.

    python tests/benchmarks/draws.py [--meshes woman] [--draws 1000]

Volumes are relative to the source: the key-frame, or the two that a shape lies between, in proportion to its time; edge
strains are the largest of each draw. New crossings are pairs of faces that cross in the draw, both of them two rings or
more away from any that cross in a source (parts that touch in a key-frame cross a little more or less with every
rounding); counted where the extra ``contact`` is installed. ``linear`` draws the same pairs and times as
``RandomInBetween``.
"""

import argparse

import numpy as np
import torch
from augment import MESHES, RandomLinear
from cases import keyframes_of
from measures import HAS_CONTACT, crossing_pairs
from numpy.typing import NDArray
from results import Table, add_keep
from tables import number, percent
from timing import limit_threads
from torch import Tensor

import torch_modal as tm

TRANSFORMS: dict[str, tm.ShapeAugmentation] = {
    "linear": RandomLinear(p=1.0),
    "`RandomInBetween`": tm.RandomInBetween(p=1.0),
    "`RandomExtrapolation`": tm.RandomExtrapolation(p=1.0),
    "`RandomModalDeformation`": tm.RandomModalDeformation(p=1.0),
}
COLUMNS = ["", "", "volume off, median", "edge strain, median", "new intersections, of draws"]


def around(pairs: NDArray[np.int64], faces: Tensor, rings: int = 2) -> Tensor:
    """Faces within so many rings of those that cross. *Shape:* ``(F,)``, bool."""
    near = torch.zeros(len(faces), dtype=torch.bool)
    near[pairs.ravel()] = True
    for _ in range(rings):
        touched = torch.zeros(int(faces.max()) + 1, dtype=torch.bool)
        touched[faces[near].flatten()] = True
        near = touched[faces].any(1)
    return near


def measure(name: str, n: int, table: Table) -> None:
    """Add a line for each transform."""
    found = keyframes_of(*MESHES[name])
    if found is None:
        return
    keyframes, faces = found
    space = tm.ShapeSpace(tm.extract_bases(keyframes, faces, 30), faces)
    pool = tm.ShapeBatch.of_keyframes(space)
    k = len(space)
    shell = tm.ShellEnergy(faces)
    volumes = shell.measure(pool.shapes.double()).volume
    old = [around(crossing_pairs(x, faces), faces) for x in pool.shapes if HAS_CONTACT]
    for kind, augment in TRANSFORMS.items():
        generator = torch.Generator().manual_seed(0)
        ratios, strains, crossed = [], [], 0
        for start in range(0, n, 20):
            rows = torch.arange(start, min(start + 20, n)) % k
            params = augment.forward_parameters(len(rows), space, generator)
            y = augment.transform(pool.rows(rows), params, space, pool).shapes
            partner, source = rows, volumes[rows]
            if "t" in params:
                partner = (rows + 1 + (params["partner"] * (k - 1)).long()) % k
                source = torch.lerp(source, volumes[partner], params["t"].clamp(0, 1))
            ratios.append(shell.measure(y.double()).volume / source)
            strains.append(space.strain(y, pool.shapes[rows]).abs().amax(1))
            for i, j, x in zip(rows, partner, y, strict=True) if old else ():
                known = old[int(i)] | old[int(j)]
                crossed += bool((~known[crossing_pairs(x, faces)]).all(1).any())
        off = float((torch.cat(ratios) - 1).abs().median())
        new = f"{100 * crossed / n:.0f} %" if old else "-"
        strain = number(float(torch.cat(strains).median()), ".2f")
        table.add(f"{name}, {keyframes.shape[1]:,} vertices", kind, percent(off), strain, new)


def main() -> None:
    """Print and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", nargs="+", default=list(MESHES), choices=list(MESHES))
    parser.add_argument("--draws", type=int, default=200, help="of each transform")
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    with Table("draws", COLUMNS, given.keep, check="--meshes creature", labels=2) as table:
        for each in given.meshes:
            measure(each, given.draws, table)


if __name__ == "__main__":
    main()
