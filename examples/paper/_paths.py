"""Where the figures find what they share with the other examples and with the benchmarks: imported before those."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path += [str(ROOT / "examples"), str(ROOT / "tests" / "benchmarks"), str(ROOT / "tests")]
