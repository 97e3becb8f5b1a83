"""A thousand draws of each random transform: volumes, edge strains, and how many pass through themselves anew.

    python tests/benchmarks/draws.py
    python tests/benchmarks/draws.py --meshes woman --intersections 250

Volumes are relative to the source: the key-frame, or the two that a shape lies between, in proportion to its time. New
crossings are pairs of faces that cross in the draw, both of them two rings or more away from any that cross in a source
(parts that touch in a key-frame cross a little more or less with every rounding); counted where the extra ``contact``
is installed. ``linear`` draws the same pairs and times as ``RandomInBetween``.
"""

import argparse

import numpy as np
import torch
from augment import MESHES, RandomLinear
from cases import keyframes_of
from measures import HAS_CONTACT, crossing_pairs
from numpy.typing import NDArray
from timing import limit_threads
from torch import Tensor

import torch_modal as tm

TRANSFORMS: dict[str, tm.ShapeAugmentation] = {
    "linear": RandomLinear(p=1.0),
    "RandomInBetween": tm.RandomInBetween(p=1.0),
    "RandomExtrapolation": tm.RandomExtrapolation(p=1.0),
    "RandomModalDeformation": tm.RandomModalDeformation(p=1.0),
    "RandomModalDeformation, large": tm.RandomModalDeformation(strain=0.05, p=1.0),
    "RandomRigidMotion": tm.RandomRigidMotion(translation=0.1, p=1.0),
}


def around(pairs: NDArray[np.int64], faces: Tensor, rings: int = 2) -> Tensor:
    """Faces within so many rings of those that cross. *Shape:* ``(F,)``, bool."""
    near = torch.zeros(len(faces), dtype=torch.bool)
    near[pairs.ravel()] = True
    for _ in range(rings):
        touched = torch.zeros(int(faces.max()) + 1, dtype=torch.bool)
        touched[faces[near].flatten()] = True
        near = touched[faces].any(1)
    return near


def measure(name: str, n: int, n_intersections: int, kinds: list[str], contact: bool) -> None:
    """Print a line for each transform."""
    found = keyframes_of(*MESHES.get(name, (name,)))
    if found is None:
        return
    keyframes, faces = found
    space = tm.ShapeSpace(tm.extract_bases(keyframes, faces, 30), faces, contact=contact)
    pool = tm.ShapeBatch.of_keyframes(space)
    k = len(space)
    shell = tm.ShellEnergy(faces)
    volumes = shell.measure(pool.shapes.double()).volume
    old = [around(crossing_pairs(x, faces), faces) for x in pool.shapes if HAS_CONTACT]
    for kind in kinds:
        augment = TRANSFORMS[kind]
        generator = torch.Generator().manual_seed(0)
        ratios, strains, new = [], [], []
        finite = 0
        for start in range(0, n, 20):
            rows = torch.arange(start, min(start + 20, n)) % k
            params = augment.forward_parameters(len(rows), space, generator)
            y = augment.transform(pool.rows(rows), params, space, pool).shapes
            finite += int(y.isfinite().flatten(1).all(1).sum())
            partner = rows
            source = volumes[rows]
            if "t" in params:
                partner = (rows + 1 + (params["partner"] * (k - 1)).long()) % k
                source = torch.lerp(source, volumes[partner], params["t"].clamp(0, 1))
            ratios.append(shell.measure(y.double()).volume / source)
            strains.append(space.strain(y, pool.shapes[rows]).abs().amax(1))
            for row in range(len(rows)):
                if old and len(new) < n_intersections:
                    known = old[int(rows[row])] | old[int(partner[row])]
                    new.append(int((~known[crossing_pairs(y[row], faces)]).all(1).sum()))
        off = (torch.cat(ratios) - 1).abs()
        strain = torch.cat(strains)
        line = f"{kind:32s}{finite:7d}{100 * float(off.median()):9.2f} %{100 * float(off.max()):7.2f} %"
        line += f"{float(strain.median()):10.3f}{float(strain.max()):8.3f}"
        if new:
            some = [number for number in new if number]
            line += f"{100 * len(some) / len(new):9.1f} % of {len(new)}"
            line += f"{sorted(some)[len(some) // 2] if some else 0:8d}"
        print(line, flush=True)


if __name__ == "__main__":
    limit_threads()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", nargs="+", default=["creature", "hand", "woman"])
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--intersections", type=int, default=300, help="draws that are searched for crossings")
    parser.add_argument("--transforms", nargs="+", default=list(TRANSFORMS), choices=list(TRANSFORMS))
    parser.add_argument(
        "--contact", action="store_true", help="spaces whose in-betweens do not pass through themselves"
    )
    given = parser.parse_args()
    for each in given.meshes:
        print(f"\n{each}")
        print(f"{'':32s}{'finite':>7s}{'volume off':>11s}{'most':>9s}{'strain':>10s}{'most':>8s}", end="")
        print(f"{'new crossings':>18s}{'pairs':>12s}")
        measure(each, given.draws, given.intersections, given.transforms, given.contact)
