"""Confidence: criteria one by one, symmetric and smooth bodies, and meshes that are too small for a map."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.bodies import limbs
from scipy.spatial.transform import Rotation

import torch_modal as tm
from torch_modal.registration.fit import sliding_freedom
from torch_modal.registration.maps import SpectralShape
from torch_modal.registration.register import register
from torch_modal.registration.report import MIRRORED_LEAD, Distances, Quality, judge
from torch_modal.registration.surface import MeshSurface

for library in ("robust_laplacian", "potpourri3d", "igl"):
    pytest.importorskip(library, reason=f"{library} is not installed; it is part of the extra 'register'")

Mesh = tuple[np.ndarray, np.ndarray]
EXACT = Distances(0.0, 0.0)
PERFECT = Quality(EXACT, EXACT, stretch=0.0, flipped_area=0.0, unsupported_area=0.0)


def judged(
    quality: Quality = PERFECT,
    *,
    map_score: float = 1.0,
    likeness: float = 1.0,
    landmark_errors: tuple[float, ...] = (),
    mirrored_lead: float = -np.inf,
    lead: float = np.inf,
    freedom: float = 0.0,
    same_subject: bool = True,
) -> tuple[float, tuple[str, ...]]:
    """Confidence and messages of a perfect result but for what is given."""
    errors = np.array(landmark_errors, dtype=float)
    confidence, _, messages = judge(quality, map_score, likeness, errors, mirrored_lead, lead, freedom, same_subject)
    return confidence, messages


def off(mean: float) -> Distances:
    return Distances(mean, 0.0)


# What is wrong, the value without confidence, the one with full confidence, and a word of the message.
ONE_SUBJECT = {
    "to target": (lambda v: {"quality": PERFECT._replace(to_target=off(v))}, 1.0, 0.3, "mean distance"),
    "from target": (lambda v: {"quality": PERFECT._replace(from_target=off(v))}, 1.0, 0.3, "mean distance"),
    "flipped": (lambda v: {"quality": PERFECT._replace(flipped_area=v)}, 0.10, 0.01, "flipped"),
    "unsupported": (lambda v: {"quality": PERFECT._replace(unsupported_area=v)}, 0.05, 0.02, "no counterpart"),
    "mirrored": (lambda v: {"mirrored_lead": v}, *MIRRORED_LEAD, "mirror image"),
    "another": (lambda v: {"lead": v}, 0.0, 0.1, "another map"),
    "sliding": (lambda v: {"freedom": v}, 0.9, 0.65, "slide"),
    "landmarks": (lambda v: {"landmark_errors": (0.5, v, 1.0)}, 8.0, 2.0, "landmark 1"),
}
SIGNS = [(True, name) for name in ONE_SUBJECT] + [(False, name) for name in ("mirrored", "another", "sliding")]


@pytest.mark.parametrize(("same_subject", "case"), SIGNS)
def test_each_sign_lowers_the_confidence(same_subject: bool, case: str) -> None:
    """Linear from the bad to the good value, limited beyond both, with one message below a half."""
    vary, bad, good, word = ONE_SUBJECT[case]
    step = good - bad
    for share in (-0.5, 0.0, 0.25, 0.75, 1.0, 1.1):
        confidence, said = judged(same_subject=same_subject, **vary(bad + share * step))
        assert confidence == pytest.approx(np.clip(share, 0, 1), abs=1e-3), share
        assert len(said) == (share < 0.5) and all(word in line for line in said), said


@pytest.mark.parametrize("same_subject", [True, False])
def test_evidence_of_a_right_map_adds_up(same_subject: bool) -> None:
    """A weak score is made up for by alike curvatures, and the reverse; the message names what is weak."""

    def probability(score: float, likeness: float, stretch: float = 0.1) -> tuple[float, str]:
        quality = PERFECT._replace(stretch=stretch)
        confidence, said = judged(quality, map_score=score, likeness=likeness, same_subject=same_subject)
        return confidence, " ".join(said)

    assert probability(0.9, 0.95)[0] > 0.99
    assert all(value > 0.9 and not said for value, said in (probability(0.6, 0.9), probability(0.85, 0.65)))
    assert probability(0.6, 0.63)[0] < 0.3 and "front and back" in probability(0.6, 0.63)[1]
    weak, reasons = probability(0.2, 0.9)
    assert weak < 0.1 and "the map scores 0.20" in reasons and "front and back" not in reasons
    torn, reasons = probability(0.7, 0.9, 1.0)
    assert torn < 0.5 and "edges change by 100 %" in reasons and "scores" not in reasons
    values = [probability(score, 0.8)[0] for score in np.linspace(-1, 1, 9)]
    assert values == sorted(values) and values[0] < 1e-6


def test_landmarks_between_subjects_replace_the_judgement_of_the_map() -> None:
    marks = {"same_subject": False, "landmark_errors": (0.1,) * 5}
    assert judged(map_score=0.0, likeness=0.0, mirrored_lead=1.0, **marks) == (1.0, ())
    stretched = PERFECT._replace(stretch=1.0)
    assert judged(stretched, **marks)[0] == 1.0 and judged(stretched, same_subject=False)[0] < 0.9
    assert "or more of them" in judged(freedom=9.0, **marks)[1][0]
    assert "or more of them" not in judged(freedom=9.0)[1][0]


# ---------------------------------------------------------------------------------------------------------- symmetries
def star() -> Mesh:
    """A prism over a star of five points."""
    angle = np.arange(10) * np.pi / 5
    radius = np.where(np.arange(10) % 2, 0.45, 1.0)
    rim = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(10)], axis=1)
    points = np.concatenate([rim, rim + np.array([0, 0, 0.4]), [[0, 0, 0], [0, 0, 0.4]]])
    here, there = np.arange(10), (np.arange(10) + 1) % 10
    low, high = np.full(10, 20), np.full(10, 21)
    sides = (here, there, there + 10), (here, there + 10, here + 10)
    caps = (low, there, here), (high, here + 10, there + 10)
    return points, np.concatenate([np.stack(corners, axis=1) for corners in (*sides, *caps)])


def symmetric(name: str) -> Mesh:
    body = {
        "box": trimesh.creation.box((1.0, 1.5, 0.7)),
        "torus": trimesh.creation.torus(1.0, 0.35, major_sections=36, minor_sections=16),
        "star": trimesh.Trimesh(*star()),
    }[name]
    if len(body.vertices) < 100:
        body = trimesh.Trimesh(*trimesh.remesh.subdivide_to_size(body.vertices, body.faces, 0.15 * body.scale / 2))
        body.merge_vertices()
    return np.array(body.vertices), np.array(body.faces, dtype=np.int64)


def tilted(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bent slightly, turned, with vertices in random order; also where each vertex of the original is."""
    random = np.random.default_rng(4)
    x, y, z = points.T
    posed = np.stack([x + 0.06 * y * y, y + 0.05 * np.sin(x), z + 0.05 * x * y], axis=1)
    truth = posed @ Rotation.random(rng=random).as_matrix().T
    order = random.permutation(len(points))
    return truth[order], np.argsort(order)[faces], truth


@pytest.mark.parametrize("name", ["star", *(pytest.param(name, marks=pytest.mark.slow) for name in ("box", "torus"))])
def test_symmetric_bodies_are_doubtful(name: str) -> None:
    """The other maps are given too, and fit as well."""
    points, faces = symmetric(name)
    target, target_faces, _ = tilted(points, faces)
    found = register(points, faces, target, target_faces, cache=False, progress=False)
    assert found.doubtful and any("another map" in line for line in found.warnings)
    assert float((found.vertex_confidence < 0.5).double().mean()) > 0.5
    surface = MeshSurface(target, target_faces)
    assert len(found.rivals) > 0
    for rival in found.rivals.numpy():
        assert surface.closest(rival).distances.mean() < 0.005 * surface.diagonal
        assert np.linalg.norm(rival - found.positions.numpy(), axis=1).max() > 0.1 * surface.diagonal


def test_landmarks_that_break_the_symmetry_restore_the_confidence() -> None:
    points, faces = symmetric("box")
    target, target_faces, truth = tilted(points, faces)
    corners = [1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1], [-1, -1, -1]
    at = [int((points @ corner).argmax()) for corner in corners]
    marks = np.stack([points[at], truth[at]], axis=1)
    found = register(points, faces, target, target_faces, landmarks=marks, cache=False, progress=False)
    errors = np.linalg.norm(found.positions.numpy() - truth, axis=1) / np.linalg.norm(np.ptp(truth, axis=0))
    assert not found.doubtful and errors.mean() < 0.02


# ------------------------------------------------------------------------------------------------------ smooth surfaces
def test_smooth_surfaces_slide() -> None:
    """More so the smoother they are and the fewer landmarks hold them, in any position and scale."""
    ball = trimesh.creation.icosphere(3)
    points, faces = np.array(ball.vertices), np.array(ball.faces)
    nothing = np.zeros(0, dtype=np.int64)

    def freedom(x: np.ndarray, triangles: np.ndarray = faces, fixed: np.ndarray = nothing) -> float:
        return sliding_freedom(SpectralShape(MeshSurface(x, triangles)), fixed)

    assert freedom(*symmetric("torus")) > 1.5
    egg = points * [1, 1.1, 1.4]
    assert freedom(points) > 5 > freedom(egg) > 1.2
    turn = Rotation.from_rotvec([1, 2, 3]).as_matrix()
    assert freedom(10 * egg @ turn + [1, 2, 3]) == pytest.approx(freedom(egg), rel=1e-3)
    samples = SpectralShape(MeshSurface(egg, faces)).samples[0]
    few, some = samples[:5], samples[:16]
    assert freedom(egg, fixed=some) < 0.65 and 0.9 < freedom(egg, fixed=few) < freedom(egg)
    assert freedom(*limbs(3)) < 0.7


def test_a_smooth_body_is_doubtful() -> None:
    """Five landmarks do not hold it, and the vertices are doubtful too."""
    ball = trimesh.creation.icosphere(3)
    bump = np.exp(4 * (np.array(ball.vertices) @ [0.6, 0.8, 0] - 1))
    points, faces = np.array(ball.vertices) * [1, 1.1, 1.4] * (1 + 0.15 * bump)[:, None], np.array(ball.faces)
    target, target_faces, truth = tilted(points, faces)
    at = [int((points @ direction).argmax()) for direction in np.vstack([np.eye(3), -np.eye(3)[:2]])]
    marks = np.stack([points[at], truth[at]], axis=1)
    found = register(points, faces, target, target_faces, landmarks=marks, cache=False, progress=False)
    assert found.doubtful and (found.vertex_confidence < 0.5).all()
    assert len(found.warnings) == 1 and "slide" in found.warnings[0]


# -------------------------------------------------------------------------------------------------------- small meshes
@pytest.mark.parametrize("tiny", ["target", "template"])
def test_meshes_too_small_for_a_map_are_refused(tiny: str) -> None:
    ball = trimesh.creation.icosphere(2)
    meshes = [(np.array(ball.vertices), np.array(ball.faces)), (np.eye(3), np.array([[0, 1, 2]]))]
    template, target = meshes if tiny == "target" else meshes[::-1]
    with pytest.raises(tm.MeshError, match=f"the {tiny}'s largest piece has 3 vertices"):
        register(*template, *target, cache=False, progress=False)
    grid = np.stack([np.arange(12.0), np.zeros(12), np.zeros(12)], axis=1)
    line = grid, np.stack([np.arange(10), np.arange(1, 11), np.arange(2, 12)], axis=1)
    template, target = (meshes[0] if tiny == "target" else line, line if tiny == "target" else meshes[0])
    with pytest.raises(tm.MeshError, match=f"the {tiny}'s.*an area of 0"):
        register(*template, *target, cache=False, progress=False)


@pytest.mark.slow
def test_no_vertex_is_trusted_in_an_exchanged_map(data_dir: Path) -> None:
    """A woman without head and shoulders is taken the wrong way round: her surface is met, her curves are not."""
    import registration

    name, (at, *_) = "mh-woman", registration.HOLES["mh-woman"][2]
    hole = registration.with_hole(name, at, 0.2, False)
    trusted = hole.found.vertex_confidence.numpy() >= 0.5
    assert (hole.errors > 5).mean() > 0.5
    assert (hole.errors[trusted] < 5).all()
