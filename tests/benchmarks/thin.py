"""Thin things: modes of the surface itself, and sheets without a thickness.

    python tests/benchmarks/thin.py [--lens] [--times] [--bodies] [--sheets] [--peer-python FILE] [--only TEXT ...]
                                    [--picture FILE.png]

All parts, or those that are named:

- ``--lens``: modes of a squashed sphere, as its thickness goes to nothing.
- ``--times``: processor seconds of the modes of one key-frame, of the surface and of the solid.
- ``--bodies``: edge errors with modes of the surface over those with modes of the solid, at t = 1/2. Where no truth is
  known, errors are to the mean lengths of both key-frames.
- ``--sheets``: flat and open surfaces whose in-betweens are known (tests/sheets.py), by modes of the surface. Edge
  errors at t = 1/4, 1/2 and 3/4, and ratios of their means to those of linear interpolation and of a peer.

``--picture`` draws key-frames and in-betweens of the sheets.
"""

from __future__ import annotations

import argparse
import os
import warnings
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

import cases
import numpy as np
import torch
import trimesh
from cases import HALF, Case, KeyframeSet
from measures import Yardstick
from methods import METHODS, UnavailableError
from sheet import look
from sheets import SHEETS, sheet
from tables import geometric_mean, number, print_table
from timing import limit_threads, timed, untimed

import torch_modal as tm

N_MODES = 30
TIMES = (0.25, HALF, 0.75)
OURS = {"subdivide": "accurate", "fast": "fast"}
"""Methods of the comparison, and the presets that they are."""
OTHERS = ("linear", "morphomatics")
TARGETS = {"linear": 0.1, "morphomatics": 1.0}
THICKNESSES = (0.1, 0.03, 0.01, 0.003, 0.001, 0.0)
ZERO = 1e-6
"""Largest eigenvalue of a rigid motion, over the first of the others."""
TIMED = {"mh-hand/00-open.obj": 1, "ict-face/00-neutral.obj": 4, "mh-woman/00-rest.obj": 4}
"""Files of the data, and into how many triangles each of theirs is cut in the end."""
SHOWN = (0.0, 0.25, HALF, 0.75, 1.0)


# ---------------------------------------------------------------------------------------------------------------- lens


def lens_rows() -> Iterator[list[str]]:
    """A line for each thickness."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    faces = np.array(ball.faces)
    for thickness in THICKNESSES:
        vertices = np.array(ball.vertices) * (1, 1, thickness)
        basis = tm.extract_modes(vertices, faces, N_MODES, method="shell", cache=False)
        rigid, first, last = (float(x) for x in (basis.rigid_eigenvalues.abs().max(), *basis.eigenvalues[[0, -1]]))
        yield [
            f"{100 * thickness:g} %",
            *(f"{x:.3g}" for x in (rigid, first, last)),
            "" if rigid < ZERO * first else "MISSED",
        ]


LENS_COLUMNS = ["thickness", "largest rigid eigenvalue", "first elastic", "last", "notes"]


# --------------------------------------------------------------------------------------------------------------- times


def time_rows(only: Sequence[str]) -> Iterator[list[str]]:
    """A line for each mesh and size."""
    for name, parts in TIMED.items():
        if not any(text in name for text in only) or not (cases.DATA / name).exists():
            continue
        keyframes, triangles = tm.load_keyframes([cases.DATA / name])
        vertices, faces = keyframes[0].numpy(), triangles.numpy()
        for level in range(1 + (parts == 4)):
            if level:
                vertices, faces = trimesh.remesh.subdivide(vertices, faces)
            seconds = [
                timed(lambda m=method, v=vertices, f=faces: tm.extract_modes(v, f, N_MODES, method=m, cache=False))[1]  # type: ignore[misc]
                for method in ("shell", "solid")
            ]
            yield [name, str(len(vertices)), *(number(x, ".2f") for x in (*seconds, seconds[0] / seconds[1]))]


TIME_COLUMNS = ["mesh", "vertices", "shell, s", "solid, s", "shell over solid"]


# -------------------------------------------------------------------------------------------------------------- bodies


def body_rows(only: Sequence[str]) -> Iterator[list[str]]:
    """A line for each pair of key-frames, then the means."""
    found: list[list[float]] = []
    for case in chain(cases.shared(), cases.samples()):
        if not any(text in case.name for text in only):
            continue
        yardstick, ends = Yardstick(case), torch.stack([case.x_a, case.x_b])
        wanted = torch.stack([yardstick.lengths(x) for x in ends]).mean(0)
        wanted = yardstick.lengths(case.truths[HALF]) if HALF in case.truths else wanted
        errors = {}
        for method in ("solid", "shell"):
            bases = tm.extract_bases(ends, case.faces, N_MODES, method=method)  # type: ignore[arg-type]
            for preset in ("accurate", "fast"):
                with torch.no_grad():
                    x = tm.InBetween(bases, case.faces, preset)(*ends, HALF)  # type: ignore[arg-type]
                errors[method, preset] = float(((yardstick.lengths(x) - wanted).abs() / wanted).mean())
        ratios = [errors["shell", preset] / errors["solid", preset] for preset in ("accurate", "fast")]
        found.append(ratios)
        shown = [errors[method, preset] for preset in ("accurate", "fast") for method in ("solid", "shell")]
        yield [case.name, *(f"{100 * error:.3f} %" for error in shown), *(number(ratio, ".3f") for ratio in ratios)]
    yield [
        "geometric mean",
        "",
        "",
        "",
        "",
        *(number(geometric_mean(list(r)), ".3f") for r in zip(*found, strict=True)),
    ]


BODY_COLUMNS = ["pair", "accurate: solid", "shell", "fast: solid", "shell", "accurate: over solid", "fast: over solid"]


# -------------------------------------------------------------------------------------------------------------- sheets


def sheet_cases(only: Sequence[str]) -> Iterator[Case]:
    """The sheets of our own making, with modes of the surface."""
    for name in SHEETS:
        if not any(text in name for text in only):
            continue
        body = sheet(name)
        faces = torch.tensor(body.faces)
        keyframes = torch.stack([torch.from_numpy(body.pose(t)) for t in (0.0, 1.0)])
        bases = tm.extract_bases(keyframes, faces, N_MODES, method="shell")
        truths = {t: torch.from_numpy(body.pose(t)) for t in TIMES}
        yield Case(name, KeyframeSet(keyframes, faces, {N_MODES: bases}), 0, 1, truths, TIMES)


def sheet_rows(only: Sequence[str]) -> Iterator[list[str]]:
    """A line for each sheet and preset."""
    for case in sheet_cases(only):
        yardstick = Yardstick(case)
        errors, notes = {}, {}
        for name in (*OURS, *OTHERS):
            try:
                outcome = METHODS[name].function(case)
            except UnavailableError as error:
                notes[name] = f"{name}: {error}"
                continue
            errors[name] = [yardstick.edge_error(x, t) for x, t in zip(outcome.frames, TIMES, strict=True)]
            if name in OURS:
                notes[name] = outcome.note
        for name, preset in OURS.items():
            mine = errors[name]
            ratios = [sum(mine) / sum(errors[other]) if other in errors else float("nan") for other in OTHERS]
            missed = [f"MISSED over {o}" for o, ratio in zip(OTHERS, ratios, strict=True) if ratio > TARGETS[o]]
            yield [
                case.name,
                preset,
                *(f"{100 * error:.3f} %" for error in mine),
                *(number(ratio, ".3f") for ratio in ratios),
                "; ".join([*missed, *(notes[n] for n in (name, *OTHERS) if n in notes)]),
            ]


SHEET_COLUMNS = ["sheet", "preset", *(f"t = {t:g}" for t in TIMES), *(f"over {name}" for name in OTHERS), "notes"]


def draw(path: Path, only: Sequence[str]) -> None:
    """A row for each sheet: the key-frames, and in-betweens of the preset "accurate"."""
    import pyvista

    drawn = list(sheet_cases(only))
    size = (230 * len(SHOWN), 170 * len(drawn))
    plotter = pyvista.Plotter(shape=(len(drawn), len(SHOWN)), off_screen=True, window_size=size, border=False)
    for i, case in enumerate(drawn):
        layer = tm.InBetween(case.bases(N_MODES), case.faces)
        for j, t in enumerate(SHOWN):
            plotter.subplot(i, j)
            with torch.no_grad():
                x = layer(case.x_a, case.x_b, t)
            polygons = pyvista.PolyData.from_regular_faces(x.numpy(), case.faces.numpy())
            plotter.add_mesh(polygons, color="#d9c49a", show_edges=False, smooth_shading=False)
            look(plotter, case.truths[HALF])
            plotter.camera.zoom(0.85)
        plotter.subplot(i, 0)
        plotter.add_text(case.name, position=(6, 150), font_size=6)
    plotter.screenshot(path)
    plotter.close()


PARTS = ("lens", "times", "bodies", "sheets")


def main(words: Sequence[str] | None = None) -> None:
    """Run the parts that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lens", action="store_true", help="modes of a squashed sphere")
    parser.add_argument("--times", action="store_true", help="how long modes take")
    parser.add_argument("--bodies", action="store_true", help="modes of the surface against those of the solid")
    parser.add_argument("--sheets", action="store_true", help="sheets of our own making, against linear and a peer")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="only what has this in its name")
    parser.add_argument("--peer-python", type=Path, metavar="FILE", help="a Python that has morphomatics")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the sheets")
    arguments = parser.parse_args(words)
    if arguments.peer_python:
        os.environ["TORCH_MODAL_PEER_PYTHON"] = str(arguments.peer_python)
    chosen = [part for part in PARTS if getattr(arguments, part)]
    chosen = chosen or ([] if arguments.picture else PARTS)
    if "lens" in chosen:
        print_table("A lens of 642 vertices: eigenvalues", LENS_COLUMNS, lens_rows())
    if "times" in chosen:
        print_table("Modes of one key-frame", TIME_COLUMNS, time_rows(arguments.only))
    if "bodies" in chosen:
        print_table("Modes of the surface and of the solid: edge errors", BODY_COLUMNS, body_rows(arguments.only))
    if "sheets" in chosen:
        with untimed():
            print_table("Sheets: edge errors", SHEET_COLUMNS, sheet_rows(arguments.only))
    if arguments.picture:
        draw(arguments.picture, arguments.only)


if __name__ == "__main__":
    limit_threads()
    warnings.simplefilter("ignore", tm.MeshWarning)
    main()
