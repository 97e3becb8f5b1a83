"""A live session: what it computes, and that its controls reach it."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import Shapes

import torch_modal as tm
from torch_modal.cli.main import main
from torch_modal.view.live import LiveSession, hit_vertex
from torch_modal.view.live_shapes import LiveShapes


@pytest.fixture
def shapes(bars: Shapes) -> LiveShapes:
    return LiveShapes(bars.keyframes, bars.faces, bars.bases)


# --------------------------------------------------------------------------------------------------- what it computes
def test_key_frames_and_in_betweens(bars: Shapes, shapes: LiveShapes) -> None:
    torch.testing.assert_close(shapes.shape(1.0), bars.keyframes[1])
    torch.testing.assert_close(shapes.shape(2.0, accurate=True), bars.keyframes[2])
    for preset, accurate in (("fast", False), ("accurate", True)):
        layer = tm.InBetween(bars.bases, bars.faces, preset)  # type: ignore[arg-type]
        with torch.no_grad():
            expected = layer(*bars.keyframes[1:], 0.25, 1)
        torch.testing.assert_close(shapes.shape(1.25, accurate), expected, rtol=0, atol=1e-6)


def test_stiffness_is_that_of_a_layer_made_with_it(bars: Shapes, shapes: LiveShapes) -> None:
    soft = shapes.shape(0.5)
    shapes.set_stiffness(0.01, 100.0, 1.0)
    objective, solver = tm.PRESETS["fast"]
    stiff = replace(objective, alpha=5.0, beta=1000.0)
    with torch.no_grad():
        expected = tm.InBetween(bars.bases, bars.faces, objective=stiff, solver=solver)(*bars.keyframes[:2], 0.5)
    torch.testing.assert_close(shapes.shape(0.5), expected, rtol=0, atol=1e-6)
    assert (soft - expected).abs().max() > 1e-4
    assert float(tm.PRESETS["fast"].objective.alpha) == 500.0, "the presets stay as they are"


def test_handles_are_met_by_the_least_energy(bars: Shapes, shapes: LiveShapes) -> None:
    vertex = 20
    target = bars.keyframes[0, vertex] + torch.tensor([0.0, 0.3, -0.2], dtype=torch.float64)
    shapes.set_handles(0, {vertex: target})
    moved = shapes.keyframes[0] - bars.keyframes[0]
    torch.testing.assert_close(shapes.keyframes[0, vertex], target, rtol=0, atol=1e-5)
    # Its amplitudes cannot be changed along what the handle does not see without costing energy (Eq. 1).
    modes, values = bars.bases[0].modes, bars.bases[0].eigenvalues
    amplitudes = torch.linalg.lstsq(modes.flatten(1).T, moved.flatten()[:, None]).solution[:, 0]
    free = torch.linalg.svd(modes[:, vertex].T).Vh[3:]
    assert (free @ (values * amplitudes)).abs().max() < 1e-5 * (values * amplitudes).abs().max()
    # What lies between follows, the other interval does not; taken away, the key-frame is as it was.
    assert (shapes.shape(0.5)[vertex] - LiveShapes(*bars).shape(0.5)[vertex]).norm() > 0.05
    torch.testing.assert_close(shapes.shape(1.5), LiveShapes(*bars).shape(1.5))
    shapes.set_handles(0, {})
    torch.testing.assert_close(shapes.keyframes, bars.keyframes)


def test_single_modes(bars: Shapes, shapes: LiveShapes) -> None:
    shapes.set_mode(1, 3, -0.5)
    moved = shapes.keyframes[1] - bars.keyframes[1]
    diagonal = (bars.keyframes[1].amax(0) - bars.keyframes[1].amin(0)).norm()
    assert float(moved.norm(dim=-1).max()) == pytest.approx(0.05 * float(diagonal))
    mode = bars.bases[1].modes[3].flatten()
    assert float(torch.cosine_similarity(moved.flatten(), mode, dim=0)) == pytest.approx(-1.0)
    shapes.reset()
    torch.testing.assert_close(shapes.keyframes, bars.keyframes)


def test_paths(shapes: LiveShapes) -> None:
    path = shapes.path(7, n_steps=4)
    assert path.shape == (9, 3)
    torch.testing.assert_close(path[2], shapes.shape(0.5)[7], rtol=0, atol=1e-6)
    torch.testing.assert_close(path[7], shapes.shape(1.75)[7], rtol=0, atol=1e-6)


def test_one_key_frame_is_refused(bars: Shapes) -> None:
    with pytest.raises(ValueError, match="two key-frames or more"):
        LiveShapes(bars.keyframes[:1], bars.faces, bars.bases[:1])
    with pytest.raises(ValueError, match="3 key-frames and 2 bases"):
        LiveShapes(bars.keyframes, bars.faces, bars.bases[:2])


def test_rays(bars: Shapes) -> None:
    shape, faces = bars.keyframes[0].numpy(), bars.faces.numpy()
    below = np.array([0.0, -100.0, 0.0])
    for vertex in (0, 50, 120):
        # Towards a vertex from outside, through the middle: its own face is met first, as the bar is convex.
        away = shape[vertex] + 5 * (shape[vertex] - shape.mean(0))
        almost = shape[vertex] + 0.02 * (shape.mean(0) - shape[vertex])
        assert hit_vertex(away, almost - away, shape, faces) == vertex
    assert hit_vertex(below, np.array([0.0, -1.0, 0.0]), shape, faces) is None


# ------------------------------------------------------------------------------------------------------- the session
@pytest.fixture
def session(shapes: LiveShapes) -> Iterator[LiveSession]:
    pytest.importorskip("viser", reason="viser (extra view) is not installed")
    running = LiveSession(shapes, "127.0.0.1", 8090)
    yield running
    running.stop()


def until(holds: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait for what other threads do."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it does not come about"
        time.sleep(0.05)


def shown(session: LiveSession) -> np.ndarray:
    """The in-between as it is shown, in the caller's coordinates."""
    return session._from_scene(session.between.vertices)


def test_session_shows_what_is_asked_for(session: LiveSession, bars: Shapes) -> None:
    def shows(expected: torch.Tensor) -> Callable[[], bool]:
        return lambda: bool(np.abs(shown(session) - expected.numpy()).max() < 1e-4)

    plain = LiveShapes(*bars)
    until(shows(plain.shape(0.5, accurate=True)))  # nothing changes: with local steps
    session.time.value = 1.25
    until(shows(plain.shape(1.25, accurate=True)))
    session.stiffness[1].value = 1.5
    plain.set_stiffness(1.0, 10**1.5, 1.0)
    until(shows(plain.shape(1.25, accurate=True)))
    session.mode_of.value, session.mode.value = 1, 3
    session.amount.value = 0.5
    plain.set_mode(1, 2, 0.5)
    until(shows(plain.shape(1.25, accurate=True)))
    until(
        lambda: bool(np.abs(session._from_scene(session.ghosts[1].vertices) - plain.keyframes[1].numpy()).max() < 1e-4)
    )


def test_session_handles_and_their_ways(session: LiveSession, bars: Shapes) -> None:
    target = bars.keyframes[0, 20].numpy() + np.array([0.0, 0.3, -0.2])
    session.add_handle(0, 20)
    session.add_handle(0, 20)  # is there already
    session.move_handle(0, 20, target)
    until(lambda: bool(np.abs(session._from_scene(session.ghosts[0].vertices[20]) - target).max() < 1e-4))
    until(lambda: session._shown_paths == {(0, 20)})
    session._undo()
    until(lambda: session._shown_paths == set())
    torch.testing.assert_close(session.shapes.keyframes, bars.keyframes)
    assert not session._handles


def test_commands_border(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["view", "a.obj", "b.obj", "--live", "--page", "x.html"])
    assert "--live" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["view", "a.obj", "b.obj", "--live", "--linear"])
