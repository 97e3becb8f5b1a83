"""Random shapes from a folder of stored key-frame sets, for PyTorch's data loaders."""

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import BatchSampler, Dataset, Sampler, get_worker_info

from torch_modal.autograd import Recent
from torch_modal.data.augmentation import AugmentationSequential, ShapeAugmentation
from torch_modal.data.random_transforms import RandomBlend
from torch_modal.data.shape_batch import ShapeBatch, check_labels
from torch_modal.data.space import ShapeSpace
from torch_modal.data.stored import StoredSet, find_sets
from torch_modal.geometry.vectors import vertex_normals
from torch_modal.threads import alone

Labels = Mapping[str, Tensor]
Sample = dict[str, Any]

OPEN_SETS = 8
"""How many sets each process keeps open."""


class ShapeDataset(Dataset[Sample]):
    """Random shapes of all key-frame sets of a folder (``torch-modal precompute``, :func:`torch_modal.write_set`).

    A sample is a transformed key-frame of its set, each in turn; partners are other key-frames of the set. It depends
    on the seed, the epoch and its index alone, not on workers or their number. (Samples of a batch are computed
    together: with another batch size they agree up to rounding.) Each process opens sets at first use and keeps only
    the most recent open, so that memory does not grow with their number.

    Each iteration of the dataset or of a :class:`SetBatchSampler` is a new epoch, and so is each pass of another
    loader: an index that a loader draws again is of its next epoch. :meth:`set_epoch` chooses another. ``data[i]`` is
    of the current epoch, as often as it is called.

    A sample is a dict: ``vertices`` (V, 3); ``set``, the index of its set in :attr:`sets`; ``keyframe``, its
    key-frame; and if requested, ``faces`` (F, 3), ``normals`` (V, 3), ``vertex_labels`` and ``shape_labels``.

    Args:
        root: Folder of stored sets, at any depth.
        transform: Transforms the key-frames; mixtures of all (:class:`RandomBlend`) by default, for labels that all
            key-frames of a set share. Its ``same_on_batch`` has no effect here.
        samples_per_set: Samples of each set in an epoch.
        labels: Returns the labels of a set: ``vertex_labels`` (V, ...) or (K, V, ...), and ``shape_labels`` (K, ...),
            each if there are any. A function of a module, if workers are spawned.
        seed: Seed of all random numbers.
        dtype: Dtype of the vertices.
        faces: Whether samples have their faces. A loader stacks them for each sample; a :meth:`space` has them once.
        normals: Whether samples have normals.
        options: Options of the spaces (:class:`ShapeSpace`), such as ``preset`` or ``dtype``.

    Raises:
        FileNotFoundError: There is no such folder, or no set in it.
        ValueError: ``samples_per_set`` is below 1, or ``seed`` below 0.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        transform: ShapeAugmentation | None = None,
        *,
        samples_per_set: int = 16,
        labels: Callable[[StoredSet], Labels] | None = None,
        seed: int = 0,
        dtype: torch.dtype = torch.float32,
        faces: bool = False,
        normals: bool = False,
        **options: Any,
    ) -> None:
        if samples_per_set < 1:
            raise ValueError(f"samples_per_set is 1 or more, got {samples_per_set}")
        self.sets = [str(path) for path in find_sets(root)]
        if not self.sets:
            raise FileNotFoundError(f"no stored key-frame set in {root}; torch-modal precompute makes them")
        #: True if samples keep the labels of all key-frames alike.
        self._mixes_all = transform is None
        transform = RandomBlend(p=1.0) if transform is None else transform
        if not isinstance(seed, int | np.integer) or seed < 0:
            raise ValueError(f"seed is an integer, 0 or more; got {seed!r}")
        is_chain = isinstance(transform, AugmentationSequential)
        self.transform = transform if is_chain else AugmentationSequential(transform)
        self.samples_per_set = samples_per_set
        self.labels = labels
        self.seed = seed
        self.dtype = dtype
        self.with_faces = faces
        self.with_normals = normals
        self.options = options
        # In shared memory: workers that outlive an epoch see the next one, and loaders see what their workers drew.
        self._epoch = torch.zeros(1, dtype=torch.int64).share_memory_()
        #: Epoch in which a loader draws each index next.
        self._next = torch.zeros(len(self), dtype=torch.int64).share_memory_()
        self._opened = Recent(OPEN_SETS)

    def __len__(self) -> int:
        """Samples in an epoch."""
        return len(self.sets) * self.samples_per_set

    @property
    def epoch(self) -> int:
        """The current epoch: the one that was set, or that an iteration began since."""
        return int(self._epoch)

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch of ``data[i]`` and of the next iteration; workers see it too, persistent ones included."""
        self._epoch.fill_(epoch)
        self._next.fill_(epoch)

    def begin_epoch(self) -> int:
        """Begin the next epoch, or the one that was set; returns its number. Iterations call this."""
        epoch = int(self._next.max())
        self._epoch.fill_(epoch)
        self._next.fill_(epoch + 1)
        return epoch

    def space(self, number: int) -> ShapeSpace:
        """Key-frames and modes of a set."""
        return self._opened.get(number, lambda: self._read(number))[0]

    def __iter__(self) -> Iterator[Sample]:
        """All samples of a new epoch."""
        epoch = self.begin_epoch()
        return (self[EpochIndex(index, epoch)] for index in range(len(self)))

    def __getitem__(self, index: int) -> Sample:
        """One sample."""
        if get_worker_info() is None:
            index = EpochIndex(index, getattr(index, "epoch", self.epoch))
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Sample]:
        """Several samples; samples of the same set are computed together. Loaders call this for each batch."""
        samples: dict[int, Sample] = {}
        by_set: dict[int, list[tuple[int, int, int]]] = {}
        for place, given in enumerate(indices):
            if not -len(self) <= given < len(self):
                raise IndexError(f"index {given} of {len(self)} samples")
            index, epoch = given % len(self), getattr(given, "epoch", None)
            if epoch is None:
                epoch = int(self._next[index])
                self._next[index] = epoch + 1
                self._epoch.fill_(epoch)
            by_set.setdefault(index // self.samples_per_set, []).append((place, index, epoch))
        with torch.no_grad(), alone():
            for number, draws in by_set.items():
                of_set = self._make_samples(number, [draw[1:] for draw in draws])
                samples.update(zip((draw[0] for draw in draws), of_set, strict=True))
        return [samples[place] for place in range(len(indices))]

    def _make_samples(self, number: int, draws: Sequence[tuple[int, int]]) -> list[Sample]:
        """Samples of one set, of indices with their epochs."""
        space, pool = self._opened.get(number, lambda: self._read(number))
        n = self.samples_per_set
        start = torch.tensor([(index % n + epoch * n) % len(space) for index, epoch in draws])
        drawn = []
        for index, epoch in draws:
            state = np.random.SeedSequence([self.seed, epoch, index]).generate_state(1, np.uint64)
            generator = torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))
            drawn.append(self.transform.forward_parameters(1, space, generator))
        params = [
            {name: torch.cat([row[name] for row in rows]) for name in rows[0]} for rows in zip(*drawn, strict=True)
        ]
        batch = self.transform.transform(pool.rows(start), params, space, pool)
        fields = {"vertices": batch.shapes, "vertex_labels": batch.vertex_labels, "shape_labels": batch.shape_labels}
        if self.with_normals:
            fields["normals"] = vertex_normals(batch.shapes, space.faces)
        # Copies: a view would carry the whole batch to another process.
        return [
            {name: tensor[row].clone() for name, tensor in fields.items() if tensor is not None}
            | {"set": number, "keyframe": int(start[row])}
            | ({"faces": space.faces} if self.with_faces else {})
            for row in range(len(draws))
        ]

    def _read(self, number: int) -> tuple[ShapeSpace, ShapeBatch]:
        """The space of a set, and its key-frames with their labels."""
        stored = StoredSet(self.sets[number])
        space = ShapeSpace.open(stored, dtype=self.dtype, **self.options)
        labels = {} if self.labels is None else dict(self.labels(stored))
        k, v = len(space), space.n_vertices
        of_vertices = labels.get("vertex_labels")
        if of_vertices is not None and of_vertices.shape[:2] != (k, v) and of_vertices.shape[:1] == (v,):
            labels["vertex_labels"] = of_vertices.expand(k, *of_vertices.shape)
        try:
            check_labels((k, v), labels)
        except ValueError as error:
            raise ValueError(f"{stored.folder}: {error}") from error
        if self._mixes_all and any(bool((each != each[:1]).any()) for each in labels.values()):
            raise ValueError(
                f"{stored.folder}: labels differ between its key-frames, and the default transform mixes all of them; "
                "pass transform=RandomInBetween(p=1.0), which follows labels"
            )
        pool = ShapeBatch.of_keyframes(space, None, labels.get("vertex_labels"), labels.get("shape_labels"))
        return space, pool


class EpochIndex(int):
    """Index of a sample in an epoch: workers that draw ahead, or for an older iteration, keep to its epoch."""

    def __new__(cls, index: int, epoch: int = 0) -> "EpochIndex":
        """An integer; unpickling sets the epoch by itself."""
        made = super().__new__(cls, index)
        made.epoch = epoch
        return made

    epoch: int


class SetBatchSampler(Sampler[list[int]]):
    """Batches whose samples are of one set, so that they can be stacked where sets have different numbers of vertices.

    Each iteration is a new epoch of the dataset.

    Args:
        dataset: The dataset.
        batch_size: Samples in a batch; the last of a set may be smaller.
        shuffle: Whether samples of a set, and batches, come in random order.
    """

    def __init__(self, dataset: ShapeDataset, batch_size: int, shuffle: bool = True) -> None:
        if batch_size < 1:
            raise ValueError(f"batch_size is 1 or more, got {batch_size}")
        self.dataset = dataset
        self.batch_size = batch_size
        self.shuffle = shuffle

    def __len__(self) -> int:
        """Number of batches in an epoch."""
        return len(self.dataset.sets) * math.ceil(self.dataset.samples_per_set / self.batch_size)

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch of the next iteration; trainers call this, with the right number after a restart."""
        self.dataset.set_epoch(epoch)

    def __iter__(self) -> Iterator[list[int]]:
        size, epoch = self.dataset.samples_per_set, self.dataset.begin_epoch()
        random = np.random.default_rng([self.dataset.seed, epoch])
        batches: list[list[int]] = []
        for number in range(len(self.dataset.sets)):
            indices = number * size + (random.permutation(size) if self.shuffle else np.arange(size))
            batches += BatchSampler(indices.tolist(), self.batch_size, drop_last=False)
        order = random.permutation(len(batches)) if self.shuffle else np.arange(len(batches))
        for place in order:
            yield [EpochIndex(index, epoch) for index in batches[place]]
