"""``torch-modal precompute``: its arguments, and from them to lines and an exit status."""

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from torch_modal.cli.arguments import add_common, add_modes, add_out, number

SUMMARY = "bases of every key-frame set of a folder tree, in several processes or machines"

DESCRIPTION = """\
Compute the bases of every key-frame set below a folder.

A set is a folder that directly holds two or more meshes of one connectivity. The output
mirrors the tree, with the key-frames and bases of each set as safetensors. Every set has a
process and a time limit of its own: one that crashes, hangs or is refused is named at the
end, and the others go on. The same command again continues where it stopped, and
recomputes sets whose files or options changed.

exit status: 0 all sets have their bases, 3 some have not, 1 an error, 130 interrupted"""

EXAMPLES = """\
examples:
  torch-modal precompute shapes --out bases
  torch-modal precompute shapes --out bases --workers 4 --timeout 120 --retry
on machines that share their files, with a Dask cluster:
  torch-modal precompute shapes --out bases --scheduler tcp://HOST:8786"""

INCOMPLETE = 3
"""Exit status when some sets have no bases."""


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``precompute``."""
    sub.add_argument("root", type=Path, metavar="DIR", help="the folder tree with the key-frames")
    add_out(sub, "DIR", "where the bases go")
    sub.add_argument(
        "--workers",
        type=number(int, 1),
        metavar="N",
        help="sets at a time, each in a process with one thread (default: one for each processor)",
    )
    sub.add_argument("--scheduler", metavar="ADDRESS", help="run on the Dask cluster with this scheduler instead")
    sub.add_argument(
        "--timeout",
        type=number(float, 0, above=True),
        metavar="S",
        default=600.0,
        help="seconds for a set, half of which the mesher may take (default: 600)",
    )
    sub.add_argument(
        "--sequence",
        action="store_true",
        help="the meshes of a folder are a motion, in natural order of their names; its file times.txt, if there is "
        "one, says when each is, and when the first comes again if it is a cycle (default: even times)",
    )
    sub.add_argument("--retry", action="store_true", help="try sets again that failed before")
    add_modes(sub)
    add_common(
        sub,
        overwrite="replace stored sets that this command did not write (default: refuse those sets)",
        cache_dir="keep tetrahedra and modes in this cache as well (default: keep the bases only)",
        all_of=False,
    )


def run(args: argparse.Namespace) -> int:
    """Run ``torch-modal precompute``; the exit status."""
    if args.out.suffix.lower() == ".safetensors":
        args.fail(f"--out is a folder here, got the file name {args.out.name!r}")
    if args.scheduler and args.workers:
        args.fail("--scheduler shares the sets among the workers of its cluster; leave out --workers")
    if threading.current_thread() is threading.main_thread():  # SIGTERM of a batch system acts like Ctrl-C
        signal.signal(signal.SIGTERM, signal.default_int_handler)

    from torch_modal.data.precompute_set import DONE, Options
    from torch_modal.data.precompute_tree import precompute_tree

    say: Callable[[str], None] = (lambda _: None) if args.quiet else _say
    options = Options(
        n_modes=args.modes,
        method=args.method,
        mesher=args.mesher,
        cache_dir=args.cache_dir and os.path.abspath(os.path.expanduser(args.cache_dir)),
        timeout=args.timeout,
        retry=args.retry,
        overwrite=args.overwrite,
        sequence=args.sequence,
    )
    records = precompute_tree(
        args.root,
        args.out,
        options,
        workers=args.workers,
        scheduler=args.scheduler,
        say=say,
        bar=not args.quiet and sys.stderr.isatty(),
    )
    return 0 if all(record.status == DONE for record in records.values()) else INCOMPLETE


def _say(line: str) -> None:
    """Print a line; escapes characters that the terminal cannot show."""
    encoding = sys.stdout.encoding or "utf-8"
    print(line.encode(encoding, "backslashreplace").decode(encoding), flush=True)
