"""The key-frames that come with the package: what they promise, and that our own code makes them."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torch_modal import load_keyframes
from torch_modal.data.samples import FOLDER, SAMPLES, load_sample, sample_files
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.inspect import (
    consistent_winding,
    degenerate_faces,
    fatness,
    find_repeated_faces,
    volume_of,
)
from torch_modal.motion.subdivide import keyframe_places
from torch_modal.times import fill_linear

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", SAMPLES)
def test_one_closed_manifold_surface_wound_outwards(name: str) -> None:
    sample = load_sample(name)
    faces = sample.faces.numpy()
    mesh = Connectivity(faces)
    edges, counts = mesh.edges, mesh.counts
    assert (counts == 2).all()  # closed, no edge of three faces
    n_vertices = sample.keyframes.shape[1]
    assert np.array_equal(np.unique(faces), np.arange(n_vertices))  # every vertex is used
    assert n_vertices - len(edges) + len(faces) == 2  # Euler: one sphere, so also one fan of faces a vertex
    assert not degenerate_faces(faces).any() and not find_repeated_faces(faces).any()
    assert len(consistent_winding(mesh)[1]) == 0
    shapes = torch.cat([sample.keyframes, sample.truth]).numpy()
    assert all(fatness(shape, faces).min() > 1e-6 for shape in shapes)
    volumes = [volume_of(shape, faces) for shape in shapes]
    assert min(volumes) > 0 and np.ptp(volumes) < 2e-3 * np.mean(volumes)
    for file in sorted(FOLDER.glob(f"{name}/*.ply")):  # corner by corner, not only as sets
        assert torch.equal(load_keyframes([file]).faces, sample.faces)


@pytest.mark.parametrize(
    ("name", "n_vertices", "n_keyframes", "n_true"), [("creature", 4840, 6, 6), ("hand", 3782, 2, 3)]
)
def test_size_and_number_of_frames(name: str, n_vertices: int, n_keyframes: int, n_true: int) -> None:
    sample = load_sample(name)
    assert sample.keyframes.shape == (n_keyframes, n_vertices, 3)
    assert sample.truth.shape == (n_true, n_vertices, 3)
    assert len(sample.true_times) == n_true
    assert sorted(FOLDER.glob(f"{name}/key-*.ply")) == sample_files(name)
    assert len(list(FOLDER.glob(f"{name}/*.ply"))) == n_keyframes + n_true


@pytest.mark.parametrize("name", SAMPLES)
def test_true_frames_lie_where_their_times_say(name: str) -> None:
    """A true frame is nearer to the linear shape of its own time than to that of any other key-frame or half."""
    sample = load_sample(name)
    linear = fill_linear(sample.keyframes, keyframe_places(len(sample.keyframes), 2, cyclic=sample.cyclic))
    for when, true in zip(sample.true_times, sample.truth, strict=True):
        distance = (linear - true).square().sum((1, 2))
        assert int(distance.argmin()) == pytest.approx(4 * when, abs=1)


def test_unknown_sample_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(ValueError, match="no sample 'horse'; there are creature, hand"):
        load_sample("horse")


@pytest.mark.slow
def test_our_own_code_makes_them(tmp_path: Path) -> None:
    """Sculpting magnifies the rounding of a machine in a few places, where a diagonal may be flipped: nine in ten
    vertices agree to 1e-5 of the size, the others to half a percent."""
    command = [sys.executable, "-m", "examples.samples.make_samples", "--out", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, timeout=900, capture_output=True)
    for name in SAMPLES:
        shipped = sorted(FOLDER.glob(f"{name}/*.ply"))
        assert [file.name for file in sorted((tmp_path / name).glob("*.ply"))] == [file.name for file in shipped]
        for file in shipped:
            made, kept = load_keyframes([tmp_path / name / file.name]), load_keyframes([file])
            assert (made.faces == kept.faces).all(-1).double().mean() > 0.98
            apart = (made.keyframes - kept.keyframes).abs().amax(-1).flatten()
            assert float(apart.quantile(0.9)) < 2e-5
            assert float(apart.max()) < 1e-2
