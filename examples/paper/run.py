"""Figures and the table of the paper, as far as they are reproduced: docs/paper.md says what is not.

python examples/paper/run.py [FOLDER]
"""

import argparse
import sys
import time
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import figure1
import figure3
import figure6
import table1

PARTS = {"Figure 1": figure1, "Figure 3": figure3, "Figures 2 and 6": figure6, "Table 1": table1}


def main(out: Path) -> None:
    """Draw and print all parts."""
    out.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore")
    for name, part in PARTS.items():
        start = time.process_time()
        lines = part.main(out)
        print(f"{name} ({time.process_time() - start:.0f} s of processor time)", *lines, "", sep="\n", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path("paper"))
    main(parser.parse_args().folder)
