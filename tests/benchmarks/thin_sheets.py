"""Sheets without a thickness, by modes of the surface.

    python tests/benchmarks/thin_sheets.py [--only TEXT ...] [--peer-python FILE] [--picture FILE.png]

Mean relative errors of edge lengths at t = 1/4, 1/2 and 3/4 of the sheets of moving_sheets.py, by modes of the
surface. Morphomatics joins where it is installed, or with ``--peer-python``. ``--picture`` draws the sheets instead.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean

import torch
from cases import HALF, Case, KeyframeSet
from error_pictures import look
from measures import Yardstick
from methods import METHODS, UnavailableError, add_peer, peer_python
from moving_sheets import SHEETS, sheet
from results import Table, add_keep, wanted
from timing import limit_threads, untimed

import torch_modal as tm

N_MODES = 30
TIMES = (0.25, HALF, 0.75)
SHOWN = (0.0, 0.25, HALF, 0.75, 1.0)


def sheet_cases(only: Sequence[str]) -> Iterator[Case]:
    """Sheets in closed form, with modes of the surface."""
    for name in SHEETS:
        if wanted(name, only):
            body = sheet(name)
            faces = torch.tensor(body.faces)
            keyframes = torch.stack([torch.from_numpy(body.pose(t)) for t in (0.0, 1.0)])
            bases = tm.extract_bases(keyframes, faces, N_MODES, method="shell")
            truths = {t: torch.from_numpy(body.pose(t)) for t in TIMES}
            yield Case(name, KeyframeSet(keyframes, faces, {N_MODES: bases}), 0, 1, truths, TIMES)


def compare_sheets(only: Sequence[str], methods: list[str], table: Table) -> None:
    """Add a row for each sheet."""
    for case in sheet_cases(only):
        yardstick, cells = Yardstick(case), []
        for name in methods:
            try:
                frames = METHODS[name](case).frames
            except UnavailableError as error:
                print(f"{case.name}, {name}: {error}", file=sys.stderr)
                cells.append("-")
            else:
                errors = [yardstick.edge_error(x, t) for x, t in zip(frames, TIMES, strict=True)]
                cells.append(f"{100 * fmean(errors):.3f} %")
        table.add(case.name, *cells)


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


def main() -> None:
    """Measure and print, or draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="only what has this in its name")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the sheets")
    add_peer(parser)
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    warnings.simplefilter("ignore", tm.MeshWarning)
    if given.picture:
        draw(given.picture, given.only or [""])
    else:
        methods = ["linear", "fast", "accurate", *(["morphomatics"] if peer_python() else [])]
        with untimed(), Table("sheets", ["sheet", *methods], given.keep, check="--only 'page folded'") as table:
            compare_sheets(given.only or [""], methods, table)


if __name__ == "__main__":
    main()
