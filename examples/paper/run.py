"""Figures and the table of the paper, as far as they are reproduced: docs/paper.md says what is not.

python examples/paper/run.py [FOLDER] [--parts 2 7 ...]
"""

import argparse
import sys
import time
import warnings
from collections.abc import Sequence
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

PARTS = {
    "1": ("Figure 1", figure1),
    "2": ("Figure 2", figure2),
    "3": ("Figure 3", figure3),
    "5": ("Figure 5", figure5),
    "6": ("Figure 6", figure6),
    "7": ("Figure 7", figure7),
    "8": ("Figure 8", figure8),
    "table": ("Table 1", table1),
}


def main(out: Path, parts: Sequence[str] = tuple(PARTS)) -> None:
    """Draw and print all parts, or some."""
    out.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore")
    for name, part in (PARTS[key] for key in parts):
        start = time.process_time()
        lines = part.main(out)
        print(f"{name} ({time.process_time() - start:.0f} s of processor time)", *lines, "", sep="\n", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path("paper"), help="default: %(default)s")
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS), help="default: all")
    given = parser.parse_args()
    main(given.folder, given.parts)
