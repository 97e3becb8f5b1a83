"""What in-betweens lose with other tetrahedra: shell energy and edge error, over those with the reference's bases.

    python tests/benchmarks/meshers.py [--samples] [--shared] [--bodies] [--slender] [--only TEXT ...]

One line for each case: shapes at t = 1/2 from two presets, with the bases of each way of meshing, over the same with
those of fTetWild at 3,000 faces, ``epsilon=2e-3``, ``stop_energy=50``. Edge errors need a truth. Below are the
geometric mean and the worst of all cases, and the processor time of the bases over that of the reference.
"""

import argparse
import warnings
from collections import defaultdict
from statistics import geometric_mean
from typing import Any

import cases
import torch
from cases import HALF, Case
from measures import Yardstick
from precompute import measured
from threads import limit_threads

import torch_modal as tm
from torch_modal.precompute.tetwild import TetrahedraSettings

REFERENCE = "tetwild"
FAST = {"edge_length_fac": None, "epsilon": 2e-3, "stop_energy": 50.0, "max_surface_faces": 3000}
WAYS: dict[str, dict[str, Any]] = {
    REFERENCE: {"mesher": "tetwild", "settings": TetrahedraSettings(**FAST)},
    "coarser": {
        "mesher": "tetwild",
        "settings": TetrahedraSettings(epsilon=4e-3, stop_energy=200.0, max_surface_faces=1500),
    },
    "lattice": {"mesher": "lattice"},
}
SOURCES = ("samples", "shared", "bodies", "slender")
PRESETS: tuple[Any, ...] = ("accurate", "fast")


def measure(case: Case, ways: list[str], made: dict[Any, Any]) -> dict[tuple[str, str], dict[str, float]]:
    """Energy and edge error of each way and preset, and the seconds of the bases."""
    yardstick = Yardstick(case)
    found = {}
    for way in ways:
        if (key := (id(case.shapes), way)) not in made:
            bases: list[tm.ModalBasis] = []
            frames = case.shapes.keyframes
            cost = measured(
                lambda bases=bases, frames=frames, way=way: bases.extend(
                    tm.extract_bases(frames, case.faces, cache=False, progress=False, **WAYS[way])
                )
            )
            made[key] = (bases, cost.processor, case.shapes)
        bases, seconds, _ = made[key]
        pair = torch.stack([case.x_a, case.x_b])
        for preset in PRESETS:
            x = tm.subdivide(
                pair, case.faces, 1, bases=[bases[case.first], bases[case.last]], preset=preset, progress=False
            )[1]
            row = {"energy": yardstick.energy(x), "seconds": seconds}
            if HALF in case.truths:
                row["edges"] = yardstick.edge_error(x, HALF)
            found[way, preset] = row
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name in SOURCES:
        parser.add_argument(f"--{name}", action="store_true")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT")
    parser.add_argument(
        "--ways", nargs="+", choices=[w for w in WAYS if w != REFERENCE], default=["coarser", "lattice"]
    )
    arguments = parser.parse_args()
    limit_threads()
    warnings.simplefilter("ignore")
    ratios: dict[tuple[str, str, str], dict[str, float]] = defaultdict(dict)
    made: dict[Any, Any] = {}
    for source in SOURCES:
        for case in getattr(cases, source)() if getattr(arguments, source) else ():
            if not any(text in case.name for text in arguments.only):
                continue
            found = measure(case, [REFERENCE, *arguments.ways], made)
            words = []
            for way in arguments.ways:
                for preset in PRESETS:
                    one, reference = found[way, preset], found[REFERENCE, preset]
                    own = {name: one[name] / reference[name] for name in one}
                    for name, value in own.items():
                        ratios[way, preset, name][case.name] = value
                    text = ", ".join(f"{name} {value:.3f}" for name, value in own.items() if name != "seconds")
                    words.append(f"{way} {preset}: {text}")
            print(f"{case.name}: " + "; ".join(words), flush=True)
    for (way, preset, name), own in ratios.items():
        worst = max(own, key=lambda case: own[case])
        asked = "" if name == "seconds" else " [1.01 and 1.03]"
        print(
            f"{way}, {preset}, {name}: mean {geometric_mean(own.values()):.3f}, worst {own[worst]:.3f} ({worst}){asked}"
        )


if __name__ == "__main__":
    main()
