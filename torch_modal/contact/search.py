"""Active contacts of a batch of in-betweens, as a term of the steps of all vertices."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_modal.autograd import transformed
from torch_modal.contact.detect import Search
from torch_modal.energy.contact import GAP, STIFFNESS, Contact
from torch_modal.energy.energy import Energy, Reference
from torch_modal.energy.modal_energy import ModalEnergy, Placement
from torch_modal.energy.term import Mesh
from torch_modal.geometry.crossings import Crossings, FloatArray, IntArray

ROUNDS = 4
"""Most searches for contacts: parts that were pushed apart may touch elsewhere."""
FINE_STEPS = 3
FINE_PRODUCTS = 20
"""Newton steps of all vertices with contacts, and iterations in each: contacts are stiff."""


def refuse_transforms(x: Tensor) -> None:
    """Refuse shapes whose numbers cannot be read, or whose tangents would be lost: the search is not torch's.

    Raises:
        RuntimeError: They are within a transform of ``torch.func``, or have a tangent.
    """
    if transformed(x):
        raise RuntimeError(
            "shapes with contact have no forward mode, and no transforms of torch.func: take torch.autograd.grad, or "
            "contact=False"
        )


class Contacts(NamedTuple):
    """The active contacts of the samples of a batch that pass through themselves."""

    samples: Tensor
    """Which of the batch these are. *Shape:* ``(S,)``."""
    elements: Tensor
    """A face and the vertex in front of it, of all samples together. *Shape:* ``(M, 4)``."""
    weights: Tensor
    """Stiffness times the area around the vertex; zero where a sample does not hold it. *Shape:* ``(S, M)``."""
    gaps: Tensor
    """Distances that are kept. *Shape:* ``(S, M)``."""

    def rows(self, some: Any) -> "Contacts":
        """Some of these samples."""
        return self._replace(samples=self.samples[some], weights=self.weights[some], gaps=self.gaps[some])

    def of_all(self, samples: Tensor) -> "Contacts":
        """The same for samples of which some may hold nothing. *Shape:* ``(S,)``."""
        weights = self.weights.new_zeros(len(samples), self.weights.shape[1])
        places = self.samples
        return Contacts(
            samples,
            self.elements,
            weights.index_copy(0, places, self.weights),
            (weights + GAP).index_copy(0, places, self.gaps),
        )

    def beside(self, former: "Contacts") -> "Contacts":
        """These contacts, and former ones of vertices that have none any more.

        What was pushed far enough not to be found again would fall back.
        """
        last = int(max(self.elements.max(), former.elements.max())) + 1
        holds = torch.zeros(len(self.weights), last, dtype=torch.bool, device=self.weights.device)
        at, which = torch.nonzero(self.weights > 0, as_tuple=True)
        holds[at, self.elements[which, 3]] = True
        kept = former.weights * ~holds[:, former.elements[:, 3]]
        elements, places = torch.cat([self.elements, former.elements]).unique(dim=0, return_inverse=True)
        own, others = places.split([len(self.elements), len(former.elements)])
        weights = self.weights.new_zeros(len(self.weights), len(elements))
        gaps = torch.full_like(weights, GAP).index_copy(1, own, self.gaps)
        gaps[:, others] = torch.where(kept > 0, former.gaps, gaps[:, others])
        return Contacts(
            self.samples, elements, weights.index_add(1, own, self.weights).index_add(1, others, kept), gaps
        )

    @property
    def term(self) -> Contact:
        """The term; its stiffness is in the weights. On the CPU, where the mesh is that its energy is made of."""
        return Contact(self.elements.cpu(), 1.0)

    def joined(self, reference: Reference) -> Reference:
        """A reference with that of the term, which comes last."""
        return Reference(
            (*reference.measures, self.gaps[:, None]), (*reference.weights, self.weights), reference.constant
        )

    def modal(self, mesh: Mesh, columns: Tensor) -> ModalEnergy:
        """The term in the amplitudes of fine columns. *Shape:* ``(n, V, 3)``."""
        energy = Energy(mesh, [self.term], sampled=True)
        return ModalEnergy(energy.to(columns.device), columns[:, energy.vertices])

    def place(self, modal: ModalEnergy, base: Tensor, extra: Tensor | None) -> Placement:
        """The samples' spaces as the term sees them. *Shape:* ``(B, V, 3)`` each."""
        vertices = modal.energy.vertices
        zero = self.weights.new_zeros(len(self.weights))
        return modal.place(
            base[:, vertices],
            self.joined(Reference((), (), zero)),
            None if extra is None else extra[:, vertices],
        )


class ContactSearch:
    """Looks for contacts in the in-betweens of several pairs of key-frames, and remembers where it found some.

    Args:
        mesh: The fine mesh.
        first: Key-frames, in the frame. *Shape:* ``(P, V, 3)``.
        second: Likewise.
        which: The pair of each sample; each its own where None. *Shape:* ``(B,)``.
        t: Times. *Shape:* ``(B,)``.
        pairs: The ``search`` of :class:`~torch_modal.geometry.crossings.Crossings`.
        is_tolerant: Whether what a key-frame has is tolerated close to it.
    """

    def __init__(
        self,
        mesh: Mesh,
        first: Tensor,
        second: Tensor,
        which: Tensor | None,
        t: Tensor,
        pairs: Callable[[FloatArray], IntArray] | None = None,
        is_tolerant: bool = True,
    ) -> None:
        known = torch.stack([first, second], 1).detach().double().cpu().numpy()
        self.searches = [Search(Crossings(mesh.connectivity, both, search=pairs)) for both in known]
        self.which = list(range(len(t))) if which is None else which.tolist()
        self.faces = mesh.faces
        self.areas = torch.stack([_areas(x.detach(), mesh.faces) for x in first])
        self.t = t.detach()
        self.is_tolerant = is_tolerant
        self.watched: list[Any] = [None] * len(t)
        #: Pairs of triangles that went through each other in the shapes that were searched last. *Shape:* ``(B,)``.
        self.n_far = torch.zeros_like(t, dtype=torch.int64)
        #: Those of them that are not tolerated. *Shape:* ``(B,)``.
        self.n_left = self.n_far

    def crossing(self, x: Tensor, some: Sequence[int]) -> Iterator[int]:
        """Those of some samples in which parts went through each other. *Shape:* ``(B, V, 3)``, of all samples."""
        return (i for i in some if self._counted(i, x[i])[1])

    def count(self, x: Tensor, some: Sequence[int] | None = None) -> None:
        """Count the pairs that cross in all samples, or some, without a search for contacts. *Shape:* ``(B, V, 3)``."""
        some = range(len(x)) if some is None else some
        self._keep(some, [self._counted(i, x[i]) for i in some])

    def _keep(self, some: Sequence[int], counts: Sequence[tuple[int, int]]) -> None:
        found = torch.tensor(counts, dtype=torch.int64, device=self.t.device).reshape(-1, 2)
        places = torch.tensor(some, dtype=torch.int64, device=self.t.device)
        self.n_far, self.n_left = (
            before.index_copy(0, places, own)
            for before, own in zip((self.n_far, self.n_left), found.unbind(1), strict=True)
        )

    def _counted(self, i: int, x: Tensor) -> tuple[int, int]:
        """Pairs of triangles that went through each other in a sample, and those of them that are not tolerated."""
        if not bool(x.isfinite().all()):
            return 0, 0
        return self._counts(i, self._search(i).crossings.far_pairs(x.detach().double().cpu().numpy()))

    def _counts(self, i: int, pairs: IntArray) -> tuple[int, int]:
        """The number of pairs in a sample, and of those that are not tolerated. *Shape:* ``(P, 2)``."""
        return len(pairs), self._search(i).n_left(pairs, float(self.t[i])) if self.is_tolerant else len(pairs)

    def __call__(self, x: Tensor, some: Sequence[int] | None = None) -> Contacts | None:
        """Contacts of the samples; None where nothing has gone through anything, now or before.

        Args:
            x: *Shape:* ``(B, V, 3)``.
            some: Those that are searched; the counts of the others stay as they are. Default: all.
        """
        some = range(len(x)) if some is None else some
        found: list[Any] = [None] * len(x)
        counts = [(0, 0)] * len(some)
        for k, i in enumerate(some):
            if bool(x[i].isfinite().all()):
                active = found[i] = self._search(i)(x[i].detach().double().cpu().numpy(), self.watched[i])
                self.watched[i] = active.watched if active.watched.any() else None
                counts[k] = self._counts(i, active.far)
        self._keep(some, counts)
        if not any(active is not None and len(active.vertices) for active in found):
            return None
        n = len(self.faces)
        nothing = torch.zeros(0, dtype=torch.int64)
        codes = [
            nothing if active is None else torch.from_numpy(active.vertices * n + active.faces) for active in found
        ]
        every = torch.cat(codes).unique()
        vertices, faces = every // n, every % n
        elements = torch.cat([self.faces[faces], vertices[:, None]], 1)
        weights = torch.zeros(len(x), len(every), dtype=x.dtype)
        gaps = torch.full_like(weights, GAP)
        for i, (code, active) in enumerate(zip(codes, found, strict=True)):
            places = torch.searchsorted(every, code)
            weights[i, places] = STIFFNESS * self.areas[self.which[i]].cpu()[vertices[places]].to(x.dtype)
            if self.is_tolerant and active is not None and active.slack.any():
                slack = torch.from_numpy(active.slack).to(x.dtype)
                ramps = torch.from_numpy(self._search(i).tolerance(active.slack, float(self.t[i]))).to(x.dtype)
                gaps[i, places] = GAP * (1 - ramps.amax(1)) - (slack * ramps).amax(1)
        own = torch.nonzero((weights > 0).any(1)).flatten()
        to = x.device
        return Contacts(own.to(to), elements.to(to), weights[own].to(to), gaps[own].to(to))

    @property
    def has_crossed(self) -> bool:
        """Whether parts went through each other in a key-frame."""
        return any(bool(search.tolerated.any()) for search in self.searches)

    def _search(self, i: int) -> Search:
        return self.searches[self.which[i]]

    def depth(self, x: Tensor) -> float:
        """How deep the contacts of one sample are, with the gap that is kept. *Shape:* ``(1, V, 3)``."""
        search, shape = self._search(0), x[0].detach().double().cpu().numpy()
        pairs = search.crossings.far_pairs(shape)
        return GAP + max(float(search.depth(shape, pairs).max()), search.crossings.reach(shape, pairs))

    def watch(self, active: Contacts, around: int) -> None:
        """Watch the active contacts of a sample and their surroundings, in that sample and its neighbours in time."""
        crossings = self.searches[0].crossings
        for i, weights in zip(active.samples.tolist(), active.weights, strict=True):
            if not bool(weights.any()):
                continue
            own = crossings.grown(active.elements[weights > 0].flatten().unique().cpu().numpy(), 2)
            for k in range(max(0, i - around), min(len(self.watched), i + around + 1)):
                self.watched[k] = own if self.watched[k] is None else self.watched[k] | own

    def beside(self, some: Tensor) -> list[int]:
        """The samples in which something is watched, but for some. *Shape:* ``(S,)``."""
        chosen = set(some.tolist())
        return [i for i, watched in enumerate(self.watched) if watched is not None and i not in chosen]

    def is_watched(self, some: Tensor) -> Tensor:
        """Whether something is watched in samples. *Shape:* ``(S,) -> (S,)``."""
        return torch.tensor([self.watched[i] is not None for i in some.tolist()], device=some.device)


def _areas(x: Tensor, faces: Tensor) -> Tensor:
    """A third of the area of the faces around each vertex. *Shape:* ``(V, 3) -> (V,)``."""
    a, b, c = (x[corner] for corner in faces.to(x.device).unbind(1))
    area = torch.linalg.cross(b - a, c - a).norm(dim=-1) / 6
    return x.new_zeros(len(x)).index_add(0, faces.to(x.device).flatten(), area[:, None].expand(-1, 3).flatten())
