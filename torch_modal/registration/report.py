"""Result and confidence of a registration."""

from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch

from torch_modal.arrays import AnyArray, ArrayLike, FloatArray
from torch_modal.errors import MeshError
from torch_modal.io.write import to_numpy
from torch_modal.registration.surface import MeshSurface, keep_pieces

Number = TypeVar("Number", float, FloatArray)

TRUSTED = 0.5  # confidence below which a result is doubtful

SLIDING = 0.9, 0.65  # freedom to slide along the target: no confidence, full confidence
LEAD = 0.0, 0.1  # advantage over the best fit along another map: no confidence, full confidence
MIRRORED_LEAD = 0.18, 0.06  # advantage of the best map onto the mirrored target: no confidence, full confidence
LOG_ODDS = 7.0
"""Log-odds that a map is right whose score, likeness of curvatures and stretch are usual for right maps."""
# Loss of log-odds per unit that each is worse, and the value where the loss begins. All are from a logistic regression
# on pairs with known truth, of one subject and of two, apart from the pairs of tests/benchmarks/people.py.
SCORE, LIKENESS, STRETCH = (16.0, 0.85), (14.5, 0.92), (7.0, 0.08)
_FAR = 0.01  # distance from the target above which a face is unsupported, in diagonals
_SHRUNK = 0.2  # area change relative to the median below which a face is unsupported: missing parts collapse
_STRAY = 0.03  # distance from the template above which a piece of the target is ignored, in diagonals


class Distances(NamedTuple):
    """Distances from vertices to the other surface, in percent of the target's diagonal; the mean is by area."""

    mean: float
    max: float

    @classmethod
    def between(cls, surface: MeshSurface, other: MeshSurface, diagonal: float) -> "Distances":
        """From ``surface`` to ``other``."""
        distances = 100 / diagonal * other.closest(surface.vertices).distances
        return cls(float(np.average(distances, weights=surface.vertex_areas)), float(distances.max()))


class Quality(NamedTuple):
    """Quality measures of a fitted template, without ground truth: the fields of these names of `Registration`."""

    to_target: Distances
    from_target: Distances
    stretch: float
    flipped_area: float
    unsupported_area: float

    def cost(self, partial: bool) -> float:
        """Cost for comparing candidates; vertices may be far from a partial target."""
        distance = self.from_target.mean + (0 if partial else self.to_target.mean)
        return self.stretch + 0.1 * distance + self.flipped_area


def measure(template: MeshSurface, x: FloatArray, target: MeshSurface) -> tuple[Quality, FloatArray]:
    """Quality of a fitted template, and the fraction of the area around each vertex with a counterpart on the target.

    *Shape:* ``(V, 3) -> (V,)``.
    """
    shape = template.with_vertices(x)
    # Pieces of the target far from the template do not count.
    pieces = target.connectivity.vertex_pieces
    nearest = np.full(pieces.max() + 1, np.inf)
    np.minimum.at(nearest, pieces, shape.closest(target.vertices).distances)
    target = keep_pieces(target, nearest <= max(_STRAY * shape.diagonal, nearest.min()))
    i, j = template.edges.T
    now, rest = (np.linalg.norm(points[i] - points[j], axis=1) for points in (x, template.vertices))
    logs = np.log(now[(now > 0) & (rest > 0)] / rest[(now > 0) & (rest > 0)])
    against = target.looks_away(shape.face_centres, shape.face_normals)
    # Faces without a counterpart are far from the target, at one of its holes, or collapsed.
    closest = target.closest(shape.face_centres)
    change = shape.face_areas / np.maximum(template.face_areas, 1e-30)
    missing = closest.distances > _FAR * target.diagonal
    missing |= change < _SHRUNK * np.median(change[template.face_areas > 0])
    missing |= target.on_open_edge(closest) & ~shape.on_boundary[shape.faces].any(1)
    supported = np.bincount(template.faces.reshape(-1), np.repeat(template.face_areas / 3 * ~missing, 3), len(x))
    quality = Quality(
        Distances.between(shape, target, target.diagonal),
        Distances.between(target, shape, target.diagonal),
        float(np.sqrt(np.mean((logs - np.median(logs)) ** 2))) if len(logs) else 0.0,
        float(template.face_areas[against].sum() / template.area),
        float(template.face_areas[missing].sum() / template.area),
    )
    return quality, supported / np.maximum(template.vertex_areas, np.finfo(np.float64).tiny)


class Registration(NamedTuple):
    """A template registered to a target. Lengths are in percent of the target's bounding-box diagonal."""

    positions: torch.Tensor
    """Positions of the template's vertices on the target, in its coordinates and the template's dtype.

    *Shape:* ``(V, 3)``.
    """
    confidence: float
    """From 0 to 1; below 0.5 the result is doubtful, and ``warnings`` gives the reasons."""
    vertex_confidence: torch.Tensor
    """From 0 to 1 for each vertex: low where the target has no part for it, and of a map that may be wrong.

    *Shape:* ``(V,)``.
    """
    map_score: float
    """Oriented area minus three times the round-trip error of the coarse map; at most 1."""
    distortion: float
    """Mean over the vertices of the largest geodesic distance error, in square roots of the area."""
    to_target: Distances
    """From the template's vertices to the target."""
    from_target: Distances
    """From the target's vertices to the template."""
    stretch: float
    """Root mean square of the edges' logarithmic change of length, relative to its median."""
    flipped_area: float
    """Fraction of the template's area with normals opposed to the target."""
    unsupported_area: float
    """Fraction of the template's area without a counterpart, such as a limb missing on the target."""
    likeness: float
    """Correlation of the curvatures of the template and of the target where it lies; at most 1."""
    landmark_errors: torch.Tensor
    """Distance of each landmark from its target. *Shape:* ``(n,)``."""
    target_corners: torch.Tensor
    """Vertices of the target's face closest to each vertex. *Shape:* ``(V, 3)``."""
    barycentric: torch.Tensor
    """Barycentric coordinates in that face. *Shape:* ``(V, 3)``."""
    rivals: torch.Tensor
    """Positions of other results that fit nearly as well, such as a mirrored one. *Shape:* ``(n, V, 3)``."""
    warnings: tuple[str, ...]
    """Reasons for a low confidence, with remedies."""

    @property
    def doubtful(self) -> bool:
        """True for a confidence below 0.5."""
        return self.confidence < TRUSTED

    def arrays(self) -> dict[str, AnyArray]:
        """Arrays for a file."""
        arrays = {name: to_numpy(value) for name, value in self._asdict().items() if name != "warnings"}
        return arrays | {"warnings": np.frombuffer("\n".join(self.warnings).encode(), dtype=np.uint8)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, AnyArray]) -> "Registration":
        """Inverse of `arrays`."""
        fields: dict[str, Any] = {"warnings": tuple(arrays["warnings"].tobytes().decode().splitlines())}
        fields |= {name: Distances(*arrays[name].tolist()) for name in ("to_target", "from_target")}
        for name in arrays.keys() - fields.keys():
            fields[name] = torch.from_numpy(arrays[name]) if arrays[name].ndim else arrays[name].item()
        return cls(**fields)

    def sample(self, values: ArrayLike) -> torch.Tensor:
        """Transfer attributes from the target's vertices to the template's vertices.

        Floats (colours, texture coordinates) are interpolated in the closest face; integers and booleans (labels) come
        from the nearest of its corners.

        Args:
            values: One row for each vertex of the target. *Shape:* ``(V_target, ...)``.

        Returns:
            *Shape:* ``(V, ...)``, same dtype.

        Raises:
            MeshError: There are fewer rows than vertices.
        """
        rows = torch.as_tensor(values)
        if rows.ndim == 0 or len(rows) <= int(self.target_corners.max()):
            raise MeshError(
                f"values have shape {tuple(rows.shape)}; one row for each vertex of the target is needed, at least "
                f"{int(self.target_corners.max()) + 1}"
            )
        corners = self.target_corners.to(rows.device)
        if not (rows.is_floating_point() or rows.is_complex()):
            nearest = self.barycentric.to(rows.device).argmax(1, keepdim=True)
            return rows[corners.gather(1, nearest)[:, 0]]
        weights = self.barycentric.to(rows).reshape(*corners.shape, *[1] * (rows.ndim - 1))
        return (weights * rows[corners]).sum(1)

    def summary(self) -> str:
        """One-line report."""
        marks = f", landmarks within {float(self.landmark_errors.max()):.2f} %" if len(self.landmark_errors) else ""
        return (
            f"confidence {self.confidence:.2f}, distance {self.to_target.mean:.3f} % there and "
            f"{self.from_target.mean:.3f} % back (at most {max(self.to_target.max, self.from_target.max):.1f} %), "
            f"stretch {100 * self.stretch:.0f} %, flipped area {100 * self.flipped_area:.1f} %, "
            f"without target {100 * self.unsupported_area:.1f} %{marks}"
        )


def ramp(value: Number, bad: float, good: float) -> Number:
    """Linear ramp from 0 at ``bad`` to 1 at ``good``."""
    return np.clip((value - bad) / (good - bad), 0, 1)


def judge(
    quality: Quality,
    map_score: float,
    likeness: float,
    landmark_errors: FloatArray,
    mirrored_lead: float,
    lead: float,
    freedom: float,
    same_subject: bool,
) -> tuple[float, float, tuple[str, ...]]:
    """Confidence, the minimum of several criteria; the probability that the map is right; messages for what fails."""
    distance, missing = max(quality.to_target.mean, quality.from_target.mean), quality.unsupported_area
    criteria = {
        f"the mean distance of the surfaces is {distance:.2f} % of the diagonal": ramp(distance, 1.0, 0.3),
        f"{100 * quality.flipped_area:.1f} % of the area are flipped": ramp(quality.flipped_area, 0.10, 0.01),
        f"{100 * missing:.1f} % of the template have no counterpart, see vertex_confidence": ramp(missing, 0.05, 0.02),
        "the template is so smooth that it can slide along the target": ramp(freedom, *SLIDING),
        "another map fits nearly as well": ramp(lead, *LEAD),
    }
    right = 1.0
    if same_subject or not len(landmark_errors):
        losses = {
            f"the map scores {map_score:.2f}, right ones mostly 0.6 and more": SCORE[0] * (SCORE[1] - map_score),
            f"curvatures correlate by {likeness:.2f}, in right maps mostly 0.8 and more: parts may be exchanged, such "
            "as front and back": LIKENESS[0] * (LIKENESS[1] - likeness),
            f"edges change by {100 * quality.stretch:.0f} % in the mean": STRETCH[0] * (quality.stretch - STRETCH[1]),
        }
        reasons = "; ".join(what for what, loss in losses.items() if 2 * loss > max(losses.values()))
        right = float(1 / (1 + np.exp(sum(max(loss, 0) for loss in losses.values()) - LOG_ODDS)))
        criteria[reasons] = right
        criteria["the target looks like a mirror image of the template"] = ramp(mirrored_lead, *MIRRORED_LEAD)
    advice = "look at the result, and give landmarks (five or more) on both meshes"
    if len(landmark_errors):
        worst, error = int(landmark_errors.argmax()), float(landmark_errors.max())
        criteria[f"landmark {worst} is {error:.1f} % off its place"] = ramp(error, 8.0, 2.0)
        advice += ", or more of them"
    warnings = tuple(f"{what}; {advice}" for what, value in criteria.items() if value < TRUSTED)
    return float(min(criteria.values())), right, warnings
