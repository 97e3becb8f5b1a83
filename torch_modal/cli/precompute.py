"""``torch-modal precompute``: its arguments, and from them to lines and an exit status."""

import argparse
import os
import re
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
process and a time limit of its own: one that crashes, hangs or is refused is written to
precompute-report.jsonl, and the others go on. The same command again continues where it
stopped, and recomputes sets whose files or options changed.

exit status: 0 all sets have their bases, 3 some have not, 1 an error, 130 interrupted"""

EXAMPLES = """\
examples:
  torch-modal precompute shapes --out bases
  torch-modal precompute shapes --out bases --workers 4 --timeout 120 --retry
on machines that share their files, with a Dask cluster or an array of jobs:
  torch-modal precompute shapes --out bases --scheduler tcp://HOST:8786
  sbatch --array=1-16 --wrap "torch-modal precompute shapes --out bases\""""

INCOMPLETE = 3
"""Exit status when some sets have no bases."""


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``precompute``."""
    sub.add_argument("root", type=Path, metavar="DIR", help="the folder tree with the key-frames")
    add_out(sub, "DIR", "where the bases and the report go")
    sub.add_argument(
        "--workers",
        type=number(int, 1),
        metavar="N",
        help="sets at a time, each in a process with one thread (default: one for each processor)",
    )
    sub.add_argument("--scheduler", metavar="ADDRESS", help="run on the Dask cluster with this scheduler instead")
    sub.add_argument(
        "--shard",
        type=_shard,
        metavar="I/N",
        help="only the I-th of N parts of the sets (default: by SLURM_ARRAY_TASK_ID, or RANK and WORLD_SIZE, if they "
        "are set and there is no --scheduler; 1/1 for all)",
    )
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
    if args.out.suffix.lower() in (".safetensors", ".jsonl"):
        args.fail(f"--out is a folder here, got the file name {args.out.name!r}")
    if args.scheduler and (args.workers or args.shard):
        args.fail("--scheduler shares the sets among the workers of its cluster; leave out --workers and --shard")
    try:
        shard = args.shard or ((1, 1) if args.scheduler else _shard_by_environment())
    except (ValueError, argparse.ArgumentTypeError) as error:
        args.fail(f"the variables SLURM_ARRAY_TASK_* or RANK and WORLD_SIZE make no sense ({error}); give --shard")
    if threading.current_thread() is threading.main_thread():  # SIGTERM of a batch system acts like Ctrl-C
        signal.signal(signal.SIGTERM, signal.default_int_handler)

    from torch_modal.data.batch.engines import dask_cluster, local_processes
    from torch_modal.data.batch.precompute import DONE, Options, Shard, precompute_tree

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
    bar = not args.quiet and sys.stderr.isatty()
    with dask_cluster(args.scheduler) if args.scheduler else local_processes(args.workers) as engine:
        records = precompute_tree(args.root, args.out, engine, options, shard=Shard(*shard), say=say, bar=bar)
    if all(record.status == DONE for record in records):
        return 0
    # A non-zero status would make torchrun end the other shards.
    return 0 if "TORCHELASTIC_RUN_ID" in os.environ else INCOMPLETE


def _shard_by_environment() -> tuple[int, int]:
    """The shard of this process in an array of jobs or a group of processes."""
    for job, first, count in (
        ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_MIN", "SLURM_ARRAY_TASK_COUNT"),
        ("RANK", "", "WORLD_SIZE"),
    ):
        if job in os.environ and count in os.environ:
            return _shard(f"{int(os.environ[job]) - int(os.environ.get(first, 0)) + 1}/{os.environ[count]}")
    return 1, 1


def _shard(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]+)/([0-9]+)", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise argparse.ArgumentTypeError(f"a shard is I/N with I from 1 to N, 3/16 for example; got {text!r}")
    return int(match[1]), int(match[2])


def _say(line: str) -> None:
    """Print a line; escapes characters that the terminal cannot show."""
    encoding = sys.stdout.encoding or "utf-8"
    print(line.encode(encoding, "backslashreplace").decode(encoding), flush=True)
