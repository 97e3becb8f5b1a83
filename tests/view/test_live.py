"""The example of a session in the browser starts, and its controls reach the motion."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes
from project.test_examples import load_example

pytest.importorskip("viser", reason="viser is not installed")


@pytest.fixture
def live(bars: Shapes) -> Iterator[Any]:
    session = load_example("live").Live(bars.keyframes, bars.faces, port=8090, n_modes=8)
    yield session
    session.server.stop()


def shown(session: Any) -> torch.Tensor:
    """The shape of the motion that is shown, in the caller's coordinates."""
    return torch.from_numpy(np.array(session.mesh.vertices)) * (session.size / 2) + session.centre


def test_controls_edit_the_motion(live: Any, bars: Shapes) -> None:
    live.time.value = 1.0
    live.update()
    torch.testing.assert_close(shown(live), bars.keyframes[1], rtol=0, atol=1e-5)
    live.amplitudes[0].value = 5.0
    live.update()
    assert (shown(live) - bars.keyframes[1]).abs().max() > 0.01
    live.amplitudes[0].value = 0.0

    live.add_handle(live.keyframes[1], 20)
    target = bars.keyframes[1, 20] + torch.tensor([0.0, 0.3, -0.2])
    live.keyframes[1].handles[20].position = live.to_scene(target)
    live.move_handles(live.keyframes[1])
    live.update()
    torch.testing.assert_close(shown(live)[20], target, rtol=0, atol=1e-4)

    live.time.value = 0.5
    live.insert()
    assert len(live.keyframes) == 4 == len(live.editor.keyframes)
    live.update()
    torch.testing.assert_close(shown(live), live.editor.keyframes[1], rtol=0, atol=1e-5)
    live.insert()
    assert len(live.keyframes) == 4, "there is a key-frame at this time already"
