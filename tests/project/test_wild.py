"""The wild set: bodies are what they claim to be, their middle is known, and no crash or hang ends a run."""

import os
import signal
import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import pytest
import torch
from wild import Row, Worker, attempt, edge_error, edge_lengths, guarded, straight, table
from wild_bodies import bent_and_twisted
from wild_making import BODIES, WildBody, ball, stretched

import torch_modal as tm

KINDS = list(dict.fromkeys(body.kind for body in BODIES.values()))
SLOW = (
    "octopus",
    "spider",
    "tree",
    "figure",
    "gyroid",
    "lattice",
    "frame of",
    "chain of tori",
    "41 balls",
    "20,480",
    "60,000",
)


def quick(kind: str) -> list[WildBody]:
    """Bodies that are made in a moment."""
    return [b for b in BODIES.values() if b.kind == kind and not any(text in b.name for text in SLOW)]


def is_closed(faces: np.ndarray) -> bool:
    """Whether each directed edge has one opposite one."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, back = ({tuple(side) for side in way.tolist()} for way in (sides, sides[:, ::-1]))
    return len(there) == len(sides) and there == back


def test_there_are_more_than_a_hundred_bodies_and_some_are_tried_with_contact() -> None:
    assert len(BODIES) > 100 and len(KINDS) >= 12
    assert 10 <= sum(body.contact for body in BODIES.values()) <= 25


@pytest.mark.parametrize("kind", KINDS)
def test_bodies_are_closed_where_claimed_and_linear_interpolation_is_wrong(kind: str) -> None:
    bodies = quick(kind)
    for body in bodies:
        vertices, faces = body.make()
        again = body.make()
        assert np.array_equal(vertices, again[0]) and np.array_equal(faces, again[1]), body.name
        assert np.isfinite(vertices).all() and faces.min() >= 0 and faces.max() < len(vertices), body.name
        if body.closed is not None:
            assert is_closed(faces) == body.closed, body.name
        rest, half, end = (torch.from_numpy(bent_and_twisted(vertices, faces, t)) for t in (0.0, 0.5, 1.0))
        assert torch.allclose(rest, torch.from_numpy(vertices), rtol=0, atol=1e-12 * float(abs(vertices).max())), (
            body.name
        )
        assert 0.002 < edge_error(straight(rest, end, faces), half, faces) < 0.2, body.name
    assert bodies or kind == "units"


def test_the_axis_keeps_its_length_and_its_frame_turns_evenly() -> None:
    """Along a thin rod: chords of a helix whose frame turns by 60 degrees about two axes, half of that half-way."""
    n, length = 2001, 4.0
    spine = np.linspace(-length / 2, length / 2, n)[:, None] * [1.0, 0, 0]
    ring = np.array([[0, 0.2, 0], [0, -0.2, 0], [0, 0, 0.1], [0, 0, -0.1]])
    rod = np.concatenate([spine, spine[:1] + ring, spine[-1:] + ring])
    faces = np.arange(len(rod) - len(rod) % 3).reshape(-1, 3)
    faces = np.concatenate([faces, [[len(rod) - 3, len(rod) - 2, len(rod) - 1]]])
    for t in (0.5, 1.0):
        shape = bent_and_twisted(rod, faces, t)
        chords = np.linalg.norm(np.diff(shape[:n], axis=0), axis=1)
        assert np.allclose(chords, length / (n - 1), rtol=1e-6)
        first, last = (
            np.column_stack([e[0] - e[1], e[2] - e[3]]) / [0.4, 0.2] for e in (shape[n : n + 4], shape[n + 4 :])
        )
        frames = [np.column_stack([np.cross(e[:, 0], e[:, 1]), e]) for e in (first, last)]
        turned = np.arccos((np.trace(frames[1] @ frames[0].T) - 1) / 2)
        assert np.degrees(turned) == pytest.approx(60 * np.sqrt(2) * t, rel=1e-6)  # 60 of bending, 60 of twist
        assert np.allclose(first.T @ first, np.eye(2), atol=1e-12)  # sections stay as they are


def test_short_edges_do_not_dominate_the_edge_error() -> None:
    vertices, faces = ball(1)
    i, j = faces[0, :2]
    vertices[j] = vertices[i] + 1e-9
    truth = torch.from_numpy(vertices)
    found = truth.clone()
    found[j] += 1e-4
    assert edge_lengths(truth, faces).min() < 1e-8
    assert edge_error(found, truth, faces) < 1e-3
    assert edge_error(2 * truth, truth, faces) == pytest.approx(1.0, rel=0.1)


def test_own_errors_are_refusals_and_others_are_foreign() -> None:
    assert guarded(lambda: 3) == (3, None)
    outcome, reason = guarded(lambda: tm.extract_bases(np.zeros((2, 4, 3)), np.array([[0, 1, 9]])))[1]  # type: ignore[misc]
    assert outcome == "refused" and "MeshError" in reason and ".py" in reason
    assert guarded(lambda: np.zeros(3) + np.zeros(4))[1][0] == "foreign"  # type: ignore[index]
    assert guarded(lambda: tm.ShellEnergy(torch.tensor([[0, 1, 2]]))(1, 2))[1][0] == "foreign"  # type: ignore[index]


def test_a_body_is_tried_with_all_ways() -> None:
    said: list[Any] = []
    body = WildBody("small", "plain", lambda: stretched(ball(1), 3, 1, 1), True, False)
    attempt(body, [("accurate", False), ("fast", False)], said.append)
    rows = [row for row in said if isinstance(row, Row)]
    assert [step for step in said if isinstance(step, str)] == ["modes", "in-between", "in-between"]
    assert [row.outcome for row in rows] == ["good", "good"]
    assert all(0 < row.ratio < 1 and row.modes > 0 and row.seconds > 0 for row in rows)
    assert "small" not in table(rows) and " 0." in table(rows)


def stubborn(pipe: Connection) -> None:
    """Ends itself in "fast", never comes back from "paper"."""
    os.setsid()
    while True:
        name, ways, _ = pipe.recv()
        pipe.send("modes")
        for preset, contact in ways:
            pipe.send("in-between")
            if preset == "fast":
                os.kill(os.getpid(), signal.SIGKILL)
            if preset == "paper":
                time.sleep(1000)
            pipe.send(Row(name, "plain", preset, contact, "good"))
        pipe.send("done")


def test_a_crash_and_a_hang_are_rows_and_the_run_goes_on() -> None:
    worker = Worker(0.005, stubborn, "fork")
    try:
        ways = [("accurate", False), ("fast", False), ("accurate", True), ("paper", False), ("accurate", False)]
        rows = list(worker.try_body(BODIES["sphere"], ways))
        assert [row.outcome for row in rows] == ["good", "died", "good", "hang", "good"]
        assert "exit code -9" in rows[1].reason and "in-between: no answer in 1 s" in rows[3].reason
        assert [row.outcome for row in worker.try_body(BODIES["cube"], ways[:1])] == ["good"]
    finally:
        worker.stop()
