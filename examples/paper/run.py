"""Figures and the table of the paper, as far as they are reproduced: docs/paper.md says what is not.

python examples/paper/run.py [FOLDER] [--parts 2 7 ...] [--only TEXT ...] [--keep]

Each part prints a table, and draws its pictures where a folder is given.
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


def main() -> None:
    """Draw and print all parts, or some."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="of the pictures")
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS), help="default: all")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="rows whose names hold one of these")
    add_keep(parser)
    given = parser.parse_args()
    if given.folder:
        given.folder.mkdir(parents=True, exist_ok=True)
    limit_threads()
    warnings.simplefilter("ignore")
    for name, part in ((name, PARTS[name]) for name in given.parts):
        print(f"\n{part.__doc__.splitlines()[0]}")
        check, labels = f"--parts {name} --only {part.CHECK}", getattr(part, "LABELS", 1)
        timed = [column for column in part.COLUMNS if column.endswith(", s")]
        with Table(f"paper-{part.__name__}", part.COLUMNS, given.keep, timed, check, labels) as table:
            table.content["command"] = f"python examples/paper/run.py --parts {name}"
            part.main(table, given.folder, given.only)


if __name__ == "__main__":
    main()
