"""Two meshes in common coordinates, with coarse copies and landmarks."""

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.progress import ProgressReport
from torch_modal.registration.maps import MORE_SIGNS, CoarsePair, SpectralShape
from torch_modal.registration.surface import drop_unreferenced, main_part, outward

MIN_VERTICES = MORE_SIGNS + 3  # minimum number of vertices of a surface: two more than eigenfunctions


class MeshPair(CoarsePair):
    """Both meshes in percent of the target's diagonal, the target centred, the template with equal area.

    Args:
        template: *Shape:* ``(V, 3), (F, 3)``.
        target: *Shape:* ``(V_target, 3), (F_target, 3)``.
        points: Landmarks on both. *Shape:* ``(n, 2, 3)``.
        same_subject: False if parts may grow and shrink.
        progress: Counts the steps.
    """

    def __init__(
        self,
        template: tuple[FloatArray, IntArray],
        target: tuple[FloatArray, IntArray],
        points: FloatArray,
        same_subject: bool,
        progress: ProgressReport,
    ) -> None:
        self.same_subject, self.progress = same_subject, progress
        (source, self.used), (goal, self.target_vertices) = (
            drop_unreferenced(vertices, outward(vertices, faces)) for vertices, faces in (template, target)
        )
        # The main bodies, without stray pieces, determine the sizes.
        bodies = {"template": main_part(source), "target": main_part(goal)}
        for name, body in bodies.items():
            if len(body.vertices) < MIN_VERTICES or body.area == 0:
                raise MeshError(
                    f"the {name}'s largest piece has {len(body.vertices)} vertices and an area of {body.area:.3g}; "
                    f"registration needs {MIN_VERTICES} vertices or more, and an area: give a finer mesh"
                )
        self.unit, self.origin = bodies["target"].diagonal / 100, bodies["target"].vertices.mean(0)
        self.target = goal.with_vertices((goal.vertices - self.origin) / self.unit)
        size = np.sqrt(bodies["target"].area / bodies["template"].area) / self.unit
        self.rest = template[0] * size
        self.template = source.with_vertices(source.vertices * size)
        super().__init__(SpectralShape(self.template), SpectralShape(self.target))
        self.partial &= same_subject
        self.marks = points[:, 0] * size, (points[:, 1] - self.origin) / self.unit
        shapes = (self.first, self.template), (self.second, self.target)
        vertices = [
            shape.placed.nearest_alike(places, surface.face_normals[surface.closest(places).faces])
            for (shape, surface), places in zip(shapes, self.marks, strict=True)
        ]
        #: Landmarks as coarse vertices. *Shape:* ``(n, 2)``.
        self.mark_vertices = np.stack(vertices, axis=1)
