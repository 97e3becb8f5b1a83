"""The benchmark of registered pairs, on a folder in its layout."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from test_tips import figure

import torch_modal as tm

maps = pytest.importorskip("maps", reason="the extra 'register' is not installed")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flat figure, and a bent one with vertices in another order; every second vertex is a common place."""
    folder = tmp_path_factory.mktemp("maps")
    points, faces = figure(level=3)
    x, y, z = points.T
    bent = np.stack([x + 0.03 * y * y, y + 0.05 * np.sin(x), z + 0.02 * x * y], axis=1)
    order = np.random.default_rng(3).permutation(len(points))
    number = np.argsort(order)
    other = cKDTree(points).query(points * [-1, 1, 1])[1]
    places = np.arange(0, len(points), 2)
    (folder / "vtx_5k").mkdir()
    (folder / "corres").mkdir()
    for name, vertices, triangles, renumber in (
        ("flat", points, faces, np.arange(len(points))),
        ("bent", bent[order], number[faces], number),
    ):
        tm.save_mesh(vertices, triangles, folder / "vtx_5k" / f"{name}.off")
        np.savetxt(folder / "corres" / f"{name}.vts", renumber[places] + 1, fmt="%d")
        np.savetxt(folder / "corres" / f"{name}.sym.vts", renumber[other[places]] + 1, fmt="%d")
    (folder / "test_pairs.txt").write_text("flat\tbent\n\n")
    return folder


def test_a_folder_is_registered_and_scored_beside_published_numbers(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["maps.py", str(folder), "--same-subject", "--keep", str(tmp_path)])
    monkeypatch.setattr(maps, "limit_threads", lambda: None)
    maps.main()
    pair, whole, trusted, published = json.loads((tmp_path / "maps.json").read_text())["rows"]
    assert pair[0] == "flat on bent" and whole[1:] == trusted[1:] == pair[1:]
    direct, best, best_of_vertices = map(float, pair[2:5])
    assert 0 <= best_of_vertices <= best == direct < 1
    assert pair[5:8] == ["1", "0", "0"]
    assert published[0] == "published, across species" and published[3] == "13.4, 26.2, 27.7"


def test_errors_of_the_true_and_of_the_mirrored_map(folder: Path) -> None:
    flat, bent = (maps.read_body(folder, name) for name in ("flat", "bent"))
    x = np.zeros_like(flat.surface.vertices)
    x[flat.direct] = bent.surface.vertices[bent.direct]
    assert maps.errors(x, flat, bent) == pytest.approx((0, 0, 0), abs=1e-9)
    mirrored = x.copy()
    mirrored[flat.direct] = bent.surface.vertices[bent.other]
    direct, best, best_of_vertices = maps.errors(mirrored, flat, bent)
    assert direct > 20 and (best, best_of_vertices) == pytest.approx((0, 0), abs=1e-9)
    # Arms exchanged, and legs as they are: no side fits all, but each place has a side that fits.
    upper = bent.surface.vertices[bent.direct][:, 1] > 0
    x[flat.direct[upper]] = mirrored[flat.direct[upper]]
    some, best, best_of_vertices = maps.errors(x, flat, bent)
    assert direct > some >= best > 1 and best_of_vertices == pytest.approx(0, abs=1e-9)


def test_errors_are_along_the_surface(folder: Path) -> None:
    """From the tip of one leg to the other one is farther on the figure than through the air, in any units."""
    flat = maps.read_body(folder, "flat")
    x = flat.surface.vertices
    legs = [int((x @ [side, -1.0, 0.0]).argmax()) for side in (1, -1)]
    straight = 100 * np.linalg.norm(x[legs[0]] - x[legs[1]]) / np.sqrt(flat.surface.area)
    found = maps.lengths(flat.surface, x[legs[:1]], x[None, legs[1:]])[0, 0]
    large = flat.surface.with_vertices(1000 * x)
    assert 1.1 * straight < found < 3 * straight
    assert maps.lengths(large, 1000 * x[legs[:1]], 1000 * x[None, legs[1:]])[0, 0] == pytest.approx(found, rel=1e-6)


def test_wrong_and_mirrored_maps_are_counted_among_the_trusted() -> None:
    right, mirrored, wrong = (maps.Score(*off, 0.9, 1.0) for off in ((1, 1, 1), (30, 2, 2), (40, 30, 5)))
    doubtful = maps.Score(40, 30, 5, 0.1, 1.0)
    assert maps.cells([right, mirrored, wrong, doubtful]) == ["4", "27.8", "15.8", "3.2", "3", "1", "1", "1.0"]
    assert maps.cells([]) == ["0", "-", "-", "-", "0", "0", "0", "-"]


def test_what_is_missing_is_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"test_pairs.txt: no such file"):
        maps.read_pairs(tmp_path)
    (tmp_path / "test_pairs.txt").write_text("flat bent\nflat\n")
    with pytest.raises(SystemExit, match="two names"):
        maps.read_pairs(tmp_path)
    with pytest.raises(SystemExit, match="no such file"):
        maps.read_body(tmp_path, "flat")
    with pytest.raises(SystemExit, match=r"neither corres/none.vts"):
        maps.read_places(folder, "none.vts", 10)
    with pytest.raises(SystemExit, match="from 1 to 10"):
        maps.read_places(folder, "flat.vts", 10)


def test_places_may_lie_with_the_meshes(folder: Path, tmp_path: Path) -> None:
    places = tmp_path / "vtx_5k" / "corres"
    places.mkdir(parents=True)
    (places / "a.vts").write_text("3\n1\n")
    assert maps.read_places(tmp_path, "a.vts", 3).tolist() == [2, 0]
