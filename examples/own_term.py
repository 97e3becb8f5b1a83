"""An energy term of one's own: triangles resist changes of their area, which Eq. 5 does not ask for.

python examples/own_term.py
"""

import torch

import torch_modal as tm


class Area(tm.Term):
    """Squared changes of the areas of triangles."""

    def elements(self, mesh: object) -> torch.Tensor:
        """Three vertices each."""
        return mesh.faces  # type: ignore[attr-defined, no-any-return]

    def measure(self, edges: torch.Tensor) -> torch.Tensor:
        """The area, of the two sides that leave the first vertex."""
        return 0.5 * torch.linalg.cross(edges[0], edges[1]).norm()


def main() -> tuple[torch.Tensor, torch.Tensor]:
    """A hand half-way between open and closed, without the term and with it. *Shape of each:* ``(V, 3)``."""
    keyframes, faces, *_ = tm.load_sample("hand")
    plain = tm.InBetween(keyframes, faces)(*keyframes, 0.5)
    bases = tm.extract_bases(keyframes, faces, n_modes=20)
    objective = tm.Objective(terms=(Area(50.0),))
    return plain, tm.InBetween(bases, faces, objective=objective)(*keyframes, 0.5)


if __name__ == "__main__":
    plain, stiffer = main()
    print(f"the term moves vertices by {float((stiffer - plain).norm(dim=-1).mean()):.2g} units in the mean")
