"""Does the pre-computation ever fail on a healthy mesh? Many meshings of perturbed key-frames, and what went wrong.

    nice python tests/benchmarks/soak.py [--n 300] [--mesher tetwild] [--seed 0] [--data DIR]

Each takes two key-frames of a sample or of the data beside the project, decimates them alike to a random number of
faces, turns and perturbs their vertices by a small part of the edges, and asks for the bases of both, 5 to 60 modes,
with nothing taken from a cache. A mesh that the check of the input refuses is no healthy one, and is drawn again. The
exit code is 1 if there was an error.
"""

import argparse
import sys
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from precompute import MORE, ROOT, sample
from scipy.spatial.transform import Rotation
from tqdm import tqdm

import torch_modal as tm
from torch_modal.errors import MeshError, MeshWarning
from torch_modal.precompute.coarsening import coarsen
from torch_modal.precompute.eigen import ModalAnalysisError
from torch_modal.precompute.filling import MESHERS
from torch_modal.precompute.tetrahedra import TetrahedralizationError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
FACES = (800, 2500)
NOISE = (0.0, 0.02)
"""Standard deviation of the perturbation, as a part of the mean edge."""


def sources(data: Path) -> dict[str, tuple[FloatArray, IntArray]]:
    """Key-frames of all shapes at hand."""
    samples = ROOT / "torch_modal" / "samples"
    found = {name: sample(samples / name) for name in ("creature", "hand")}
    if data.is_dir():
        found |= {f"large {name}": sample(data / MORE[name], "0*") for name in MORE}
        found |= {name: sample(data / name, "*") for name in ("mh-hand", "ict-face", "hyper-cube")}
    return found


def draw(keyframes: FloatArray, faces: IntArray, random: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """Two of the key-frames, decimated alike, turned and perturbed."""
    pair = keyframes[random.choice(len(keyframes), 2, replace=False)]
    rule = coarsen(pair[:1], faces, int(np.exp(random.uniform(*np.log(FACES)))))
    pair, faces = rule.restrict(pair), rule.faces
    edge = np.linalg.norm(pair[0][faces[:, 0]] - pair[0][faces[:, 1]], axis=1).mean()
    pair = pair @ Rotation.random(random_state=random.integers(2**31)).as_matrix().T
    return pair + edge * random.uniform(*NOISE) * random.standard_normal(pair.shape), faces


def main() -> int:
    """Mesh, count, and print what went wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n", type=int, default=300)
    parser.add_argument("--mesher", choices=MESHERS, default="tetwild")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="more, if it is there")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", MeshWarning)
    random = np.random.default_rng(arguments.seed)
    shapes = sources(arguments.data)
    errors: Counter[str] = Counter()
    seconds, refused = [], 0
    bar = tqdm(total=arguments.n, disable=None)
    while len(seconds) < arguments.n:
        name = list(shapes)[len(seconds) % len(shapes)]
        keyframes, faces = draw(*shapes[name], random)
        n_modes, start = int(random.integers(5, 61)), time.perf_counter()
        try:
            tm.extract_bases(keyframes, faces, n_modes, mesher=arguments.mesher, cache=False, progress=False)
        except MeshError:
            refused += 1
            continue
        except (ModalAnalysisError, TetrahedralizationError) as error:
            errors[type(error).__name__] += 1
            print(f"{name}, {keyframes.shape[1]} vertices, {len(faces)} faces, {n_modes} modes: {error}", flush=True)
        seconds.append(time.perf_counter() - start)
        bar.update()
    print(
        f"{arguments.n} pairs of key-frames of {len(shapes)} shapes by {arguments.mesher}: "
        f"{sum(errors.values())} errors [0 asked] {dict(errors) or ''}; {refused} draws refused"
    )
    for index, name in enumerate(shapes):
        own = seconds[index :: len(shapes)]
        print(f"  {name}: {len(own)} pairs, median {np.median(own):.1f} s, longest {max(own):.1f} s")
    return 1 if errors else 0


if __name__ == "__main__":
    sys.exit(main())
