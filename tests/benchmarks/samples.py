"""The samples of the package, whose true in-betweens are known: what ``torch-modal demo`` shows, as a table.

    python tests/benchmarks/samples.py [creature hand]

Means over the known in-betweens of the mean relative errors of edge lengths, and of the volume over the true one.
"""

import argparse

from results import Table, add_keep, percent
from timing import limit_threads

import torch_modal as tm
from torch_modal.cli.demo import errors
from torch_modal.data.samples import SAMPLES, load_sample

LEVELS = 2


def add(name: str, table: Table) -> None:
    """A row for a sample."""
    sample = load_sample(name)
    keyframes, faces, cyclic = sample.keyframes, sample.faces, sample.cyclic
    places = tm.keyframe_places(len(keyframes), LEVELS, cyclic=cyclic)
    straight = tm.linear_sequence(keyframes, places)
    own = tm.subdivide(keyframes, faces, LEVELS, cyclic=cyclic, progress=False)
    edges, volumes = zip(*(errors(sample, x, LEVELS).mean(0).tolist() for x in (straight, own)), strict=True)
    label = f"{name}, {len(keyframes)} key-frames, {keyframes.shape[1]:,} vertices"
    table.add(label, *map(percent, edges), *(f"{volume:.3f}" for volume in volumes))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[[], *SAMPLES], default=[])
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    columns = [f"{what}, {way}" for what in ("error of edge lengths", "volume") for way in ("linear", "torch_modal")]
    with Table("samples", ["", *columns], given.keep, check="hand") as table:
        for name in given.names or SAMPLES:
            add(name, table)


if __name__ == "__main__":
    main()
