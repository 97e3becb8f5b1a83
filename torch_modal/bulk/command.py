"""``torch-modal precompute``: its arguments, and from them to lines and an exit status."""

import argparse
import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

SUMMARY = "bases of every key-frame set of a folder tree, in several processes or machines"

DESCRIPTION = """\
Compute the bases of every key-frame set below a folder.

A set is a folder that directly holds two or more meshes of one connectivity. The output
mirrors the tree, with the key-frames and bases of each set as safetensors. Every set has a
process and a time limit of its own: one that crashes, hangs or is refused is written to
precompute-report.jsonl, and the others go on. The same command again continues where it
stopped, and works anew on sets whose files or options changed.

exit status: 0 all sets have their bases, 3 some have not, 1 an error, 130 interrupted"""

EXAMPLES = """\
examples:
  torch-modal precompute shapes --out bases
  torch-modal precompute shapes --out bases --workers 4 --timeout 120 --retry
on two machines that share their files, the work shared by a counter in PyTorch's TCPStore:
  torchrun --nnodes 2 --nproc-per-node 1 --rdzv-backend c10d --rdzv-endpoint HOST:29400 \\
      -m torch_modal precompute shapes --out bases"""

INCOMPLETE = 3
"""Exit status when some sets have no bases."""


def add_arguments(sub: argparse.ArgumentParser, number: Callable[..., Callable[[str], Any]]) -> None:
    """Add what this command alone has.

    Args:
        sub: Its parser.
        number: Makes the type of an argument: a number of a kind, with a lower bound.
    """
    sub.add_argument("root", type=Path, metavar="DIR", help="the folder tree with the key-frames")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the bases and the report go")
    sub.add_argument(
        "--workers",
        type=number(int, 1),
        metavar="N",
        help="sets at a time, each in a process with one thread (default: one for each processor; under torchrun "
        "those of the machine are shared among its processes)",
    )
    sub.add_argument(
        "--timeout",
        type=number(float, 0, above=True),
        metavar="S",
        default=600.0,
        help="seconds for a set, half of which the mesher may take (default: 600)",
    )
    sub.add_argument("--retry", action="store_true", help="try sets again that failed before")


def add_common(sub: argparse.ArgumentParser) -> None:
    """Add the arguments about files and messages, which mean something else for many sets."""
    group = sub.add_argument_group("files and messages")
    group.add_argument(
        "--overwrite",
        action="store_true",
        help="replace stored sets that this command did not write (default: refuse those sets)",
    )
    group.add_argument(
        "--cache-dir",
        metavar="DIR",
        help="keep tetrahedra and modes in this cache as well (default: keep the bases only)",
    )
    group.add_argument("--quiet", action="store_true", help="say nothing but warnings and errors")
    group.add_argument("--debug", action="store_true", help="show the traceback of an error")


def run(args: argparse.Namespace) -> int:
    """Run ``torch-modal precompute``; the exit status."""
    if args.out.suffix.lower() in (".safetensors", ".jsonl"):
        args.fail(f"--out is a folder here, got the file name {args.out.name!r}")

    from torch_modal.bulk.review import Options
    from torch_modal.bulk.run import precompute_tree

    options = Options(
        n_modes=args.modes,
        mesher=args.mesher,
        quality=args.quality,
        timeout=args.timeout,
        workers=args.workers,
        retry=args.retry,
        overwrite=args.overwrite,
        cache_dir=args.cache_dir,
    )
    say: Callable[[str], None] = (lambda _: None) if args.quiet else _say
    with _terminated_like_interrupted():
        result = precompute_tree(args.root, args.out, options, say=say, bar=not args.quiet and sys.stderr.isatty())
    return 0 if result.complete else INCOMPLETE


def _say(line: str) -> None:
    """Print a line, whatever names are in it."""
    encoding = sys.stdout.encoding or "utf-8"
    print(line.encode(encoding, "backslashreplace").decode(encoding), flush=True)


@contextlib.contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """End as after Ctrl-C when torchrun or a batch system asks for it: the sets' processes are to end as well."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
