"""Figures and the table of the paper, as far as they are reproduced: docs/paper.md says what is not.

python examples/paper/run.py [FOLDER] [--parts 2 7 ...] [--only TEXT ...] [--meshes DIR] [--keep]

Each part prints a table, and draws its pictures where a folder is given. ``--meshes`` runs Figures 1 and 2 and Table 1
on the paper's own animals, which are public but may not be redistributed (``_meshes.py`` says which files are read).
"""

import argparse
import sys
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import figure1
import figure2
import figure3
import figure5
import figure6
import figure7
import figure8
import table1
from results import Table, add_keep
from timing import limit_threads

PARTS = {
    "1": figure1,
    "2": figure2,
    "3": figure3,
    "5": figure5,
    "6": figure6,
    "7": figure7,
    "8": figure8,
    "table": table1,
}
WITH_MESHES = ("1", "2", "table")


def main() -> None:
    """Draw and print all parts, or some."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="of the pictures")
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), help="default: all")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="rows whose names hold one of these")
    parser.add_argument("--meshes", type=Path, metavar="DIR", help="where the meshes of deformation transfer are")
    add_keep(parser)
    given = parser.parse_args()
    names = given.parts or (WITH_MESHES if given.meshes else PARTS)
    if given.meshes and (given.keep or not set(names) <= set(WITH_MESHES)):
        parser.error(f"--meshes is for the parts {', '.join(WITH_MESHES)}, and its tables are not kept")
    if given.folder:
        given.folder.mkdir(parents=True, exist_ok=True)
    limit_threads()
    warnings.simplefilter("ignore")
    for name, part in ((name, PARTS[name]) for name in names):
        print(f"\n{part.__doc__.splitlines()[0]}")
        check, labels = f"--parts {name} --only {part.CHECK}", getattr(part, "LABELS", 1)
        timed = [column for column in part.COLUMNS if column.endswith(", s")]
        with Table(f"paper-{part.__name__}", part.COLUMNS, given.keep, timed, check, labels) as table:
            table.content["command"] = f"python examples/paper/run.py --parts {name}"
            part.main(table, given.folder, given.only, *([given.meshes] if given.meshes else []))


if __name__ == "__main__":
    main()
