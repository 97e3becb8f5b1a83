"""How near in-betweens come to a known one: linear, joint space, and the paired space over a grid of mu.

    python tests/benchmarks/quality.py [--samples]

Errors are means over the edges of the relative error of their length; volumes are ratios to the true frame's. Linear
interpolation is given the best rigid motion between the key-frames, as the others are.
"""

import argparse
import math
from itertools import chain

import torch
from cases import Case, hand_path, samples

import torch_modal as tm
from torch_modal import mesh
from torch_modal.rigid import best_fit

MU_GRID = (1e-4, 1e-3, 1e-2, 3e-2, 1e-1, 3e-1, 1.0, 10.0, 100.0)


def linear(case: Case) -> torch.Tensor:
    """Mean of the first key-frame and the second laid upon it."""
    laid = best_fit(case.x_b, case.x_a, torch.ones(len(case.x_a), dtype=case.x_a.dtype)).apply(case.x_b)
    return 0.5 * (case.x_a + laid)


def quality(x: torch.Tensor, case: Case) -> tuple[float, float]:
    """Mean relative edge-length error and volume ratio."""
    assert case.truth is not None
    i, j = torch.from_numpy(mesh.unique_edges(case.faces.numpy())[0]).T
    length, wanted = (torch.linalg.norm(shape[i] - shape[j], dim=1) for shape in (x, case.truth))
    measure = tm.ShellEnergy(case.faces).measure
    return float(((length - wanted).abs() / wanted).mean()), float(measure(x).volume / measure(case.truth).volume)


def show(method: str, x: torch.Tensor, case: Case, note: str = "") -> float:
    """Print a row; return its edge error."""
    error, volume = quality(x, case)
    print(f"  {method:<20}{100 * error:>9.2f} %{volume:>9.4f}{note:>40}", flush=True)
    return error


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", action="store_true", help="also the key-frames that come with the package")
    chosen = chain(hand_path(), samples() if parser.parse_args().samples else ())
    for case in chosen:
        print(f"{case.name}{'edge error':>24}{'volume':>9}")
        show("linear", linear(case), case)
        methods = [("joint", "joint", 0.0), *((f"paired, mu = {mu:g}", "paired", mu) for mu in MU_GRID)]
        best = (math.inf, "")
        for name, space, mu in methods:
            shapes, solution = tm.MidShape(case.bases, case.faces, space, mu).solve(case.x_a, case.x_b)
            note = f"{int(solution.n_steps)} steps, gradient {float(solution.gradient_norm):.0e}"
            error = show(name, shapes, case, note + ("" if solution.converged else ", NOT CONVERGED"))
            if space == "paired":
                best = min(best, (error, name))
        print(f"  best of the paired space: {best[1]}")


if __name__ == "__main__":
    main()
