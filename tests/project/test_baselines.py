"""What others do, as the benchmarks have it: the geodesic of Kilian et al. 2007, and Froehlich and Botsch 2011."""

import geodesic as geodesics
import numpy as np
import pytest
import torch
from bodies import bar_surface, bend
from reduced import ReducedPair, froehlich_botsch
from scipy.optimize import check_grad

TURN = torch.linalg.matrix_exp(torch.tensor([[0, -0.4, 0.2], [0.4, 0, 0.1], [-0.2, -0.1, 0]], dtype=torch.float64))


def bent_bar() -> tuple[torch.Tensor, torch.Tensor]:
    """A bar at rest, half-way and bent by 120 degrees, somewhere else each time; its faces."""
    rest, faces = bar_surface((16, 4, 4), (4.0, 1.0, 1.0))
    poses = [torch.from_numpy(bend(rest, t, np.radians(120), 0.0, 4.0)) for t in (0.0, 0.5, 1.0)]
    poses[2] = poses[2] @ TURN.T + 3
    return torch.stack(poses), torch.from_numpy(np.array(faces))


def edge_error(x: torch.Tensor, truth: torch.Tensor, faces: torch.Tensor) -> float:
    """Mean relative error of the sides of all faces."""
    found, wanted = ((y[faces] - y[faces.roll(1, 1)]).norm(dim=-1) for y in (x, truth))
    return float(((found - wanted).abs() / wanted).mean())


def test_geodesic_keeps_lengths_and_ends() -> None:
    poses, faces = bent_bar()
    found = geodesics.geodesic(poses[0], poses[2], faces, n_steps=4, levels=(200,))
    torch.testing.assert_close(found.frames[[0, -1]], poses[[0, 2]], rtol=0, atol=1e-12)
    assert found.energies[1] < found.energies[0]
    # Linear interpolation is 3.9 % off.
    assert edge_error(found.frames[2], poses[1], faces) < 0.012
    middle = found.at(torch.tensor([0.125, 0.5], dtype=torch.float64))
    torch.testing.assert_close(middle, torch.stack([found.frames[:2].mean(0), found.frames[2]]))
    with pytest.raises(ValueError, match="power of two"):
        geodesics.geodesic(poses[0], poses[2], faces, n_steps=3)


def test_gradient_of_the_path_energy() -> None:
    random = np.random.default_rng(0)
    metric = geodesics._Metric(torch.from_numpy(random.normal(size=(2, 4, 3))), torch.tensor([[0, 1, 2], [0, 2, 3]]))
    path = random.normal(size=(4, 3, 3))

    def value(flat: np.ndarray) -> float:
        return metric(flat.reshape(path.shape))[0]

    def gradient(flat: np.ndarray) -> np.ndarray:
        return metric(flat.reshape(path.shape))[1].reshape(-1)

    assert check_grad(value, gradient, path.reshape(-1)) < 1e-6 * np.abs(gradient(path.reshape(-1))).max()


def test_reduced_pair_gives_its_ends_back() -> None:
    poses, faces = bent_bar()
    reduced = ReducedPair(poses[0], poses[2], faces, 200)
    assert len(reduced.faces) < 0.6 * len(faces)
    for t, end in ((0.0, poses[0]), (1.0, poses[2])):
        torch.testing.assert_close(reduced.expand(end[reduced.chosen], t), end, rtol=0, atol=1e-9)
    moved = reduced.expand(poses[0][reduced.chosen] @ TURN.T + 1, 0.0)
    torch.testing.assert_close(moved, poses[0] @ TURN.T + 1, rtol=0, atol=1e-9)


def test_froehlich_and_botsch_keep_lengths() -> None:
    poses, faces = bent_bar()
    x = froehlich_botsch(ReducedPair(poses[0], poses[2], faces, 200), 0.5)
    assert edge_error(x, poses[1], faces) < 0.012
