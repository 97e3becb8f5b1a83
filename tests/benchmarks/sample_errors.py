"""The samples of the package, whose true in-betweens are known: what ``torch-modal demo`` shows, as a table.

    python tests/benchmarks/sample_errors.py [creature hand]

Means over the known in-betweens of the mean relative errors of edge lengths, and of the volume over the true one.
"""

import argparse

import torch
from results import Table, add_keep, percent
from timing import limit_threads

import torch_modal as tm
from torch_modal.data.samples import SAMPLES, Sample, load_sample
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.inspect import volume_of
from torch_modal.motion.subdivide import keyframe_places
from torch_modal.times import fill_linear

LEVELS = 2


def errors(sample: Sample, frames: torch.Tensor, levels: int) -> torch.Tensor:
    """Errors at the true times that fall on one of the frames, of which an interval has ``2**levels``.

    The mean of ``|l - l_true| / l_true`` over all edges, and the ratio to the true volume. *Shape:* ``(T, 2)``.
    """
    faces, rows = sample.faces.numpy(), []
    i, j = torch.tensor(Connectivity(faces).edges).T
    for when, true in zip(sample.true_times, sample.truth, strict=True):
        if (when * 2**levels).is_integer():
            x = frames[int(when * 2**levels)]
            length, true_length = ((shape[i] - shape[j]).norm(dim=-1) for shape in (x, true))
            off = float(((length - true_length).abs() / true_length).mean())
            rows.append((off, volume_of(x.numpy(), faces) / volume_of(true.numpy(), faces)))
    return torch.tensor(rows)


def add(name: str, table: Table) -> None:
    """A row for a sample."""
    sample = load_sample(name)
    keyframes, faces, cyclic = sample.keyframes, sample.faces, sample.cyclic
    places = keyframe_places(len(keyframes), LEVELS, cyclic=cyclic)
    straight = fill_linear(keyframes, places)
    own = tm.interpolate(keyframes, faces, LEVELS, cyclic=cyclic, progress=False)
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
