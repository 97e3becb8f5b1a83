"""Write the kept tables of results into the pages, or measure them again first.

    python tests/benchmarks/refresh.py [PAGE ...]
    python tests/benchmarks/refresh.py --run [PAGE ...]

Pages are names such as ``quality`` or ``README``; without one, all. With ``--run`` the command of each table runs and
keeps its results, one after the other; then the pages are written. ``TORCH_MODAL_PEER_PYTHON`` names a Python that has
morphomatics, where this one has not; without it, a new run has no results of that. The table of skins needs
py-dem-bones here.
"""

import argparse
import shlex
import subprocess
import sys

from results import PAGES, ROOT, load, names, refreshed


def main() -> None:
    """Refresh what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = {path.stem: path for path in reversed(PAGES)}  # the README of docs has no table
    parser.add_argument("pages", nargs="*", choices=[[], *known], metavar="PAGE")
    parser.add_argument("--run", action="store_true", help="measure again")
    given = parser.parse_args()
    chosen = [known[name] for name in given.pages or known]
    if given.run:
        tables = [name for path in chosen for name in names(path.read_text(encoding="utf-8"))]
        for command in dict.fromkeys(load(name)["command"] for name in tables):
            print(command, flush=True)
            subprocess.run([sys.executable, *shlex.split(command)[1:], "--keep"], cwd=ROOT, check=True)
    for path in chosen:
        page = path.read_text(encoding="utf-8")
        if refreshed(page) != page:
            path.write_text(refreshed(page), encoding="utf-8")
            print(f"{path.relative_to(ROOT)} is written anew")


if __name__ == "__main__":
    main()
