"""The quality benchmark's own rulers: each against what is known by hand or found in another way."""

import math
from pathlib import Path

import cases
import numpy as np
import pytest
import quality
import torch
from bodies import body
from measures import Row, Yardstick, crossing_pairs
from tables import gap_closed, geometric_mean, markdown, worse_than
from timing import timed, untimed

import torch_modal as tm
from torch_modal.geometry.rigid import RigidMotion


@pytest.fixture(scope="module")
def bent_bar() -> cases.Case:
    return next(cases.bodies(["bar bent 180"]))


def moved(x: torch.Tensor) -> torch.Tensor:
    turn = torch.linalg.qr(torch.tensor([[1.0, 2, 3], [0, 1, 4], [5, 6, 0]], dtype=x.dtype))[0]
    turn = turn * torch.linalg.det(turn).sign()
    return RigidMotion(turn, torch.zeros(3, dtype=x.dtype), torch.tensor([7.0, -3, 2], dtype=x.dtype)).apply(x)


def crossings_by_edges(x: np.ndarray, faces: np.ndarray) -> set[tuple[int, int]]:
    """Edges of one face through the inside of another, all against all, by signs of volumes."""

    def volume(*corners: np.ndarray) -> np.ndarray:
        a, b, c, d = corners
        return np.einsum("ni,ni->n", np.cross(b - a, c - a), d - a)

    pairs = np.array([(i, j) for i in range(len(faces)) for j in range(i) if not set(faces[i]) & set(faces[j])])
    hit = np.zeros(len(pairs), dtype=bool)
    for one, other in ((0, 1), (1, 0)):
        corners, (a, b, c) = x[faces[pairs[:, one]]], x[faces[pairs[:, other]]].transpose(1, 0, 2)
        for k in range(3):
            p, q = corners[:, k], corners[:, (k + 1) % 3]
            sides = np.stack([volume(p, q, *side) > 0 for side in ((a, b), (b, c), (c, a))])
            apart = (volume(a, b, c, p) > 0) != (volume(a, b, c, q) > 0)
            hit |= apart & (sides.all(axis=0) | ~sides.any(axis=0))
    return {(min(pair), max(pair)) for pair in pairs[hit].tolist()}


def test_crossings_are_those_of_all_pairs_tried() -> None:
    generator = np.random.default_rng(1)
    faces = np.concatenate([np.arange(150).reshape(-1, 3), generator.permutation(150)[:60].reshape(-1, 3)])
    x = generator.uniform(size=(150, 3))
    wanted = crossings_by_edges(x, faces)
    found = crossing_pairs(torch.from_numpy(x), torch.from_numpy(faces))
    assert len(wanted) > 20
    assert set(map(tuple, found.tolist())) == wanted


def test_a_bar_bent_into_itself_crosses_and_neighbours_do_not() -> None:
    shape = body("bar bent 180")
    faces = torch.from_numpy(np.array(shape.faces))
    assert len(crossing_pairs(torch.from_numpy(shape.pose(1.0)), faces)) == 0
    through = shape.rest.copy()
    through[:, 0] = np.abs(through[:, 0] - 2)  # folded in the middle, one half upon the other
    through[:, 1] += 0.5 * (shape.rest[:, 0] > 2)
    assert len(crossing_pairs(torch.from_numpy(through), faces)) > 100


def test_truth_measures_as_truth_wherever_it_lies(bent_bar: cases.Case) -> None:
    row = Row("", "")
    Yardstick(bent_bar).measure(row, moved(bent_bar.truths[0.5]), None)
    assert row.edge_error < 1e-13 and row.vertex_error < 1e-13
    assert row.volume == pytest.approx(1, rel=1e-12)
    assert (row.turned, row.folds, row.crossings) == (0, 0, 0)


def test_errors_of_a_shape_grown_by_a_tenth(bent_bar: cases.Case) -> None:
    truth = bent_bar.truths[0.5]
    row = Row("", "")
    Yardstick(bent_bar).measure(row, 1.1 * truth, None)
    spread = (truth - truth.mean(0)).square().sum(1).mean().sqrt()
    diagonal = torch.linalg.norm(truth.amax(0) - truth.amin(0))
    assert row.edge_error == pytest.approx(0.1, rel=1e-9)
    assert row.volume == pytest.approx(1.331, rel=1e-9)
    assert row.vertex_error == pytest.approx(float(0.1 * spread / diagonal), rel=1e-9)


def test_energy_does_not_depend_on_units_and_is_the_mean_against_both_ends(bent_bar: cases.Case) -> None:
    truth = bent_bar.truths[0.5]
    size = 100 / torch.linalg.norm(bent_bar.x_a.amax(0) - bent_bar.x_a.amin(0))
    shell = tm.ShellEnergy(bent_bar.faces)
    wanted = float(shell(size * truth, size * bent_bar.x_a) + shell(size * truth, size * bent_bar.x_b)) / 2
    assert Yardstick(bent_bar).energy(truth) == pytest.approx(wanted, rel=1e-12)
    other = cases.KeyframeSet(17.0 * bent_bar.shapes.keyframes, bent_bar.faces)
    grown = cases.Case("", other, 0, 1, {})
    assert Yardstick(grown).energy(17.0 * truth) == pytest.approx(wanted, rel=1e-9)


def test_a_face_pushed_through_is_turned_and_folds_its_hinges(bent_bar: cases.Case) -> None:
    yardstick = Yardstick(bent_bar)
    x = bent_bar.truths[0.5].clone()
    edges = yardstick.edges
    interior = torch.argmin((bent_bar.x_a - torch.tensor([2.0, 0.5, 0.0], dtype=x.dtype)).norm(dim=1))
    around = edges[(edges == interior).any(1)].unique()
    around = around[around != interior]
    x[interior] = 2.5 * x[around[0]] - 1.5 * x[interior]  # past one neighbour
    row = Row("", "")
    yardstick.measure(row, x, None)
    assert row.turned >= 1 and row.folds >= 1


def test_gap_and_loss_by_hand() -> None:
    linear, full = Row("c", "linear", energy=10.0, edge_error=0.2), Row("c", "full", energy=2.0, edge_error=0.1)
    middle = Row("c", "joint", energy=4.0, edge_error=0.25, seconds=0.5)
    assert gap_closed(middle, linear, full) == pytest.approx(0.75)
    assert gap_closed(linear, linear, full) == 0 and gap_closed(full, linear, full) == 1
    assert math.isnan(gap_closed(middle, linear, None))
    assert worse_than(middle, linear) == ["edge error"]
    assert worse_than(full, linear) == []
    assert geometric_mean([1.0, 4.0, math.nan]) == pytest.approx(2)
    text = markdown([linear, full, middle])
    assert "| 0.750 |" in text and "c (edge error)" in text and "20.00 %" in text


def test_a_folder_gives_its_frames_their_places(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sheet = body("sheet rolled 270")
    tm.save_frames(np.stack([sheet.pose(i / 3) for i in range(4)]), sheet.faces, tmp_path, "obj")
    (case,) = cases.folder(tmp_path)
    assert sorted(case.truths) == pytest.approx([1 / 3, 2 / 3])
    assert torch.allclose(case.x_b, torch.from_numpy(sheet.pose(1.0)), atol=1e-5)
    assert torch.allclose(case.truths[1 / 3], torch.from_numpy(sheet.pose(1 / 3)), atol=1e-5)
    assert not Yardstick(case).has_volume

    results = tmp_path / "results.json"
    said = []
    for _ in range(2):  # the second time from what is kept
        quality.main([str(tmp_path), "--methods", "truth", "linear", "--results", str(results)])
        said.append(capsys.readouterr().out)
    assert f"| {tmp_path.name} " in said[0] and "| linear |" in said[0]
    assert said[1] == said[0]


def test_times_are_of_the_best_call_and_may_be_left_out() -> None:
    calls = []
    result, seconds = timed(lambda: calls.append(sum(range(10_000))) or len(calls))
    assert result == 1 and 0 < seconds < 1 and len(calls) > 2
    with untimed():
        calls.clear()
        assert timed(lambda: calls.append(1))[1] == math.inf and calls == [1]
