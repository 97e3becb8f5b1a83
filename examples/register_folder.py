"""All meshes of a folder on the connectivity of one, with a table; the trusted ones become a space of shapes.

python examples/register_folder.py TEMPLATE FOLDER OUT
"""

import sys
from pathlib import Path

import torch

import torch_modal as tm
from torch_modal.cli.main import main as run


def main(template: Path, folder: Path, out: Path) -> tm.ShapeSpace:
    """Register, and read the trusted results."""
    code = run(["register", str(template), str(folder), "--across", "--out", str(out), "--overwrite"])
    if code not in (0, 3):  # 3: some are doubtful, and left out
        raise SystemExit(code)
    files = sorted(out.glob(f"*{template.suffix}"))
    shapes, faces = tm.load_keyframes([template, *files])
    aligned = torch.stack([tm.align(x, shapes[0]) for x in shapes])
    return tm.ShapeSpace(aligned, faces)


if __name__ == "__main__":
    space = main(*map(Path, sys.argv[1:4]))
    print(f"{len(space)} shapes of {space.n_vertices} vertices")
