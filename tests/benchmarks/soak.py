"""Does anything ever fail on a healthy mesh? Many perturbed pairs of key-frames, and what went wrong.

    nice python tests/benchmarks/soak.py [--n 300] [--mesher NAME] [--preset NAME] [--seed 0]

Each takes two key-frames of a sample or of the data beside the project, decimates them alike to a random number of
faces, turns and perturbs their vertices by a small part of the edges, and asks for the bases of both, 5 to 60 modes,
with nothing taken from a cache, and for an in-between at a random time, all by default settings. An exception of any
kind is an error, and so is a shape with a good status that is not finite, or whose energy on the fine mesh is more than
1.1 times that of linear interpolation, each without the 1 % of edges and hinges that have most of it: a few needles can
have half of the energy. (Edge lengths alone would be no measure: the perturbations of both key-frames differ, and
bending has its part in what is best.) A mesh that the check of the input refuses is no healthy one, and is
drawn again. The exit code is 1 if there was an error.
"""

import argparse
import sys
import time
import warnings
from collections import Counter

import numpy as np
import torch
from cases import DATA, animal, keyframes_of
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from timing import limit_threads
from tqdm import tqdm
from wild import FELL_BACK, WORSE, straight

import torch_modal as tm
from torch_modal.elastic.minimise import Status
from torch_modal.errors import MeshError
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.inbetween.settings import PRESETS
from torch_modal.modes.coarsening import coarsen
from torch_modal.modes.extract import MESHERS

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
FACES = (800, 2500)
NOISE = (0.0, 0.02)
"""Standard deviation of the perturbation, as a part of the mean edge."""
WORST = 0.01
"""Part of the elements that is left out."""


def sources() -> dict[str, tuple[FloatArray, IntArray]]:
    """Key-frames of all shapes at hand."""
    folders = ("mh-hand-path", "mh-woman", "mh-hand", "ict-face", "hyper-cube")
    found = {file.stem: animal(file.stem)[:2] for file in sorted((DATA / "animals").glob("*.npz"))}
    found |= {name: own for name in ("creature", "hand", *folders) if (own := keyframes_of(name))}
    return {name: (keyframes.numpy(), faces.numpy()) for name, (keyframes, faces) in found.items()}


def draw(keyframes: FloatArray, faces: IntArray, random: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """Two of the key-frames, decimated alike, turned and perturbed."""
    pair = keyframes[random.choice(len(keyframes), 2, replace=False)]
    n_faces = int(np.exp(random.uniform(*np.log(FACES))))
    if n_faces < len(faces):
        rule = coarsen(pair[:1], faces, n_faces)
        pair, faces = rule.restrict(pair), rule.faces
    edge = np.linalg.norm(pair[0][faces[:, 0]] - pair[0][faces[:, 1]], axis=1).mean()
    pair = pair @ Rotation.random(random_state=random.integers(2**31)).as_matrix().T
    return pair + edge * random.uniform(*NOISE) * random.standard_normal(pair.shape), faces


def in_between(
    bases: list[tm.ModalBasis], pair: FloatArray, faces: IntArray, time: float, preset: str
) -> tuple[str, str]:
    """The status of an in-between, and what is wrong where its status is good and its shape is not."""
    x_a, x_b = torch.from_numpy(pair)
    layer = tm.InBetween(bases, torch.from_numpy(faces), preset)  # type: ignore[arg-type]
    with torch.no_grad():
        result = layer.solve(x_a, x_b, time)
    status = Status(int(result.solution.status))
    shell, scale = tm.ShellEnergy(layer.faces), CANONICAL_SIZE / torch.linalg.norm(x_a.amax(0) - x_a.amin(0))

    def energy(x: torch.Tensor) -> float:
        given = ((end * scale, pull) for end, pull in ((x_a, 1 - time), (x_b, time)))
        parts = torch.cat([pull * shell.residuals(x * scale, end) ** 2 for end, pull in given])
        return float(parts.sort().values[: round((1 - WORST) * len(parts))].sum())

    ratio = energy(result.shapes) / energy(straight(x_a, x_b, faces, time))
    good = status == FELL_BACK or not bool(result.solution.usable) or ratio <= WORSE  # not so with NaN
    return status.name, "" if good else f"silent: {ratio:.2f} times the energy of linear interpolation"


def main() -> int:
    """Mesh, count, and print what went wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n", type=int, default=300)
    parser.add_argument("--mesher", choices=MESHERS, help="in the place of the default")
    parser.add_argument("--preset", choices=[name for name in PRESETS if name != "paper"], default="accurate")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    random = np.random.default_rng(arguments.seed)
    shapes = sources()
    chosen = {} if arguments.mesher is None else {"mesher": arguments.mesher}
    errors: Counter[str] = Counter()
    statuses: Counter[str] = Counter()
    seconds, refused = [], 0
    bar = tqdm(total=arguments.n, disable=None)
    while len(seconds) < arguments.n:
        name = list(shapes)[len(seconds) % len(shapes)]
        n_modes, at, start = int(random.integers(5, 61)), random.uniform(), time.perf_counter()
        keyframes, faces = shapes[name]
        failed = ""
        try:
            keyframes, faces = draw(*shapes[name], random)
            bases = tm.extract_bases(keyframes, faces, n_modes, cache=False, progress=False, **chosen)
            status, failed = in_between(bases, keyframes, faces, at, arguments.preset)
            statuses[status] += 1
        except MeshError:
            refused += 1
            continue
        except Exception as error:  # of any kind: that none leaves is what is tried
            failed = f"{type(error).__name__}: {error}"
        if failed:
            errors[failed.split(":")[0]] += 1
            print(
                f"{name}, {keyframes.shape[1]} vertices, {len(faces)} faces, {n_modes} modes, t = {at:.2f}: {failed}",
                flush=True,
            )
        seconds.append(time.perf_counter() - start)
        bar.update()
    print(
        f"{arguments.n} pairs of key-frames of {len(shapes)} shapes, {arguments.mesher or 'default'} mesher, "
        f"{arguments.preset}: {sum(errors.values())} errors [0 asked] {dict(errors) or ''}; {refused} draws refused; "
        f"statuses {dict(statuses)}"
    )
    for index, name in enumerate(shapes):
        own = seconds[index :: len(shapes)]
        if own:
            print(f"  {name}: {len(own)} pairs, median {np.median(own):.1f} s, longest {max(own):.1f} s")
    return 1 if errors else 0


if __name__ == "__main__":
    limit_threads()
    sys.exit(main())
