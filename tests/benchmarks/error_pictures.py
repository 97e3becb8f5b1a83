"""Pictures of results: shapes coloured by the errors of their edges."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from cases import HALF, Case
from measures import Yardstick
from methods import Outcome

from torch_modal.geometry.connectivity import Connectivity

WORST = 0.2  # relative edge error at the end of the colour scale


def draw_sheet(found: dict[Case, dict[str, Outcome]], path: Path) -> None:
    """A row for each case, a column for the truth and each method.

    Colours are the mean relative edge errors around a vertex, from pale (none) to dark red (``WORST`` and more).
    """
    import pyvista

    methods = list(dict.fromkeys(["truth", *(name for outcomes in found.values() for name in outcomes)]))
    size = (260 * len(methods), 240 * len(found))
    plotter = pyvista.Plotter(shape=(len(found), len(methods)), off_screen=True, window_size=size, border=False)
    for i, (case, outcomes) in enumerate(found.items()):
        yardstick = Yardstick(case)
        truth = case.truths.get(HALF)
        shapes = {name: x.frames[0] for name, x in outcomes.items()} | ({} if truth is None else {"truth": truth})
        ends = [case.x_a, case.x_b] if truth is None else [truth]
        wanted = torch.stack([yardstick.lengths(x) for x in ends]).mean(0)
        guide = truth if truth is not None else next(iter(shapes.values()))
        for j, name in enumerate(methods):
            if name not in shapes:
                continue
            plotter.subplot(i, j)
            x = yardstick.laid(shapes[name], guide)
            error = (yardstick.lengths(x) - wanted).abs() / wanted
            polygons = pyvista.PolyData.from_regular_faces(x.numpy(), case.faces.numpy())
            polygons["error"] = around_vertices(error, Connectivity(case.faces.numpy()).edges, len(x))
            plotter.add_mesh(polygons, clim=(0, WORST), cmap="YlOrRd", show_scalar_bar=False, smooth_shading=False)
            plotter.add_text(f"{name}\n{case.name}", position=(6, 206), font_size=6)
            look(plotter, guide)
    plotter.screenshot(path)
    plotter.close()


def around_vertices(error: torch.Tensor, edges: np.ndarray, n_vertices: int) -> np.ndarray:
    """Mean over the edges of each vertex. *Shape:* ``(E,), (E, 2) -> (V,)``."""
    total, count = torch.zeros(2, n_vertices, dtype=error.dtype)
    for end in torch.tensor(edges).T:
        total.index_add_(0, end, error)
        count.index_add_(0, end, torch.ones_like(error))
    return (total / count.clamp_min(1)).numpy()


def look(plotter: Any, shape: torch.Tensor) -> None:
    """From the direction in which a shape is thinnest, somewhat aside."""
    centred = shape - shape.mean(0)
    wide, high, thin = torch.linalg.svd(centred, full_matrices=False).Vh
    view = thin + 0.35 * high + 0.25 * wide
    plotter.view_vector(view.tolist(), viewup=high.tolist())
    plotter.camera.zoom(1.1)
