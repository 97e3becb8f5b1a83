"""Table 1: sizes and times, of the samples of this package and of the bodies of Figures 2 and 7, next to the paper's.

The paper's columns: vertices of the surface (#V) and of the tetrahedra (#N), key-frames (#K), dimension of the space
(#D). IT is tetrahedra and modes of all key-frames, without the cache; UT is one mid-shape of a pair whose layer is
ready: of the preset ``"paper"``, and of the default. Processor seconds of this machine, child processes included; the
paper's are of an Intel Core i7-3370 of 3.4 GHz.
"""

import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import _paths  # noqa: F401
import torch
from _meshes import gallop, poses
from results import Table, wanted
from samples.bipeds import KINDS, biped

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.surface import Surface
from torch_modal.modes.lattice import Lattice
from torch_modal.modes.tetrahedra import Mesher, Tetrahedra
from torch_modal.modes.tetwild import TetWild

COLUMNS = ["model", "#V", "#N", "#K", "#D", "IT, s", "UT, s", "UT by default, s"]
CHECK = "hand"
N_MODES = 50
DENSE = TetWild(edge_length_fac=0.007, epsilon=1e-3, max_surface_faces=10**8, timeout=3600)
"""As many tetrahedra as the paper's."""
ROWS: dict[str, tuple[Mesher, tuple[tuple[str, ...], ...]]] = {
    "creature": (Lattice(), ()),
    "creature, fTetWild": (
        DENSE,
        (
            ("paper: horse", "8,431", "51.4K", "6", "100", "69.24", "0.32"),
            ("paper: lion", "5,000", "29.5K", "2", "60", "39.10", "0.09"),
            ("paper: cat", "7,207", "41.4K", "2", "60", "58.36", "0.09"),
        ),
    ),
    "hand": (Lattice(), (("paper: hand", "13,071", "50.2K", "2", "100", "31.86", "0.28"),)),
    "wader": (Lattice(), (("paper: flamingo", "26,284", "103K", "2", "100", "153.01", "0.73"),)),
    "person": (Lattice(), (("paper: women", "25,381", "93.7K", "2", "100", "96.06", "0.12"),)),
}
"""Bodies and their meshers, and the paper's rows for those most like them."""


def processor() -> float:
    """Seconds of the processor, of this process and of its children."""
    return sum(os.times()[:4])


MESHES = {"horse": 50, "lion": 30, "cat": 30}
"""Modes of each key-frame of the paper's own meshes, for ``--meshes``."""


def key_poses(name: str, meshes: Path | None) -> tuple[torch.Tensor, torch.Tensor]:
    """Key-frames and faces of a sample, of a body, or of a mesh of the paper."""
    if meshes:
        if name == "horse":
            return gallop(meshes)[:2]
        shapes, faces = poses(meshes, name)
        return shapes[:2], faces
    if name in KINDS:
        body = biped(name, None)
        return torch.stack([torch.from_numpy(body.pose(t)) for t in (0.0, 1.0)]), torch.from_numpy(body.faces)
    sample = load_sample(name)
    return sample.keyframes, sample.faces


@dataclass
class Counted:
    """A mesher that notes how many vertices it gave."""

    mesher: Mesher
    counts: list[int] = field(default_factory=list)

    def key(self) -> dict[str, Any]:
        """That of the mesher."""
        return self.mesher.key()

    def fill(self, surface: Surface, stop: threading.Event) -> Tetrahedra:
        """Tetrahedra of the mesher."""
        found = self.mesher.fill(surface, stop)
        self.counts.append(len(found.vertices))
        return found


def main(table: Table, out: Path | None, only: Sequence[str], meshes: Path | None = None) -> None:
    """A row for each body, and the paper's."""
    published = {row[0].removeprefix("paper: "): row for _, theirs in ROWS.values() for row in theirs}
    rows = {name: (Lattice(), (published[name],)) for name in MESHES} if meshes else ROWS
    for name, (mesher, theirs) in rows.items():
        if not wanted(name, only):
            continue
        x, faces = key_poses(name.split(",")[0], meshes)
        n_modes = MESHES[name] if meshes else N_MODES
        counted = Counted(mesher)
        start = processor()
        bases = tm.extract_bases(x, faces, n_modes, mesher=counted, cache=False, progress=False)
        prepare, updates = processor() - start, []
        for preset in ("paper", "accurate"):
            layer = tm.MidShape(bases[:2], faces, preset=preset)
            with torch.no_grad():
                layer(*x[:2])
                start = processor()
                layer(*x[:2])
            updates.append(f"{processor() - start:.2f}")
        sizes = f"{x.shape[1]:,}", f"{counted.counts[0]:,}", str(len(x)), str(2 * n_modes)
        table.add(name, *sizes, f"{prepare:.1f}", *updates)
        for row in theirs:
            table.add(*row, "")
