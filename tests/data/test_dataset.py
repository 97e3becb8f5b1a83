"""The dataset over stored sets: deterministic, safe in workers, and small in memory."""

import gc
import pickle
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Shapes
from safetensors.torch import load_file, save_file
from torch.utils.data import DataLoader, Subset, default_collate

import torch_modal as tm
from torch_modal.data.dataset import SetBatchSampler
from torch_modal.data.in_betweens import FORMAT, VERSION
from torch_modal.data.stored import StoredSet
from torch_modal.geometry.vectors import vertex_normals
from torch_modal.io.tensors import TensorFile, write_tensors

N_SETS, PER_SET = 3, 8


@pytest.fixture(scope="module")
def root(bars: Shapes, small_bars: Shapes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sets of one connectivity and one of another, at different depths."""
    folder = tmp_path_factory.mktemp("sets")
    names = ["straight", "bent", "twisted"]
    tm.write_set(folder / "a", *bars, names)
    tm.write_set(folder / "deep" / "b", bars.keyframes.flip(0), bars.faces, bars.bases[::-1], names[::-1])
    tm.write_set(folder / "deep" / "small", *small_bars, names)
    return folder


def everything(p: float = 0.7) -> tm.AugmentationSequential:
    return tm.AugmentationSequential(
        tm.RandomInBetween(p=p),
        tm.RandomModalDeformation(p=p),
        tm.RandomRigidMotion(p=p),
    )


def dataset(root: Path, **options: Any) -> tm.ShapeDataset:
    return tm.ShapeDataset(root, everything(), **{"samples_per_set": PER_SET, "normals": True, "seed": 4, **options})


def batches(data: tm.ShapeDataset, epochs: int = 1, **options: Any) -> list[dict[str, Any]]:
    loader = DataLoader(data, batch_sampler=SetBatchSampler(data, 4), **options)
    found = []
    for epoch in range(epochs):
        data.set_epoch(epoch)
        found += list(loader)
    return found


def assert_same(found: list[dict[str, Any]], expected: list[dict[str, Any]]) -> None:
    assert len(found) == len(expected)
    for mine, its in zip(found, expected, strict=True):
        assert mine.keys() == its.keys()
        for name in mine:
            assert torch.equal(torch.as_tensor(mine[name]), torch.as_tensor(its[name])), name


def test_a_dataset_gives_samples_of_all_its_sets(root: Path, bars: Shapes) -> None:
    data = dataset(root, faces=True)
    assert len(data) == N_SETS * PER_SET
    assert [Path(path).name for path in data.sets] == ["a", "b", "small"]
    sample = data[0]
    assert sorted(sample) == ["faces", "keyframe", "normals", "set", "vertices"]
    assert (sample["vertices"].shape, sample["vertices"].dtype) == ((164, 3), torch.float32)
    assert torch.equal(sample["faces"], bars.faces)
    assert torch.equal(data.space(0).faces, bars.faces)
    torch.testing.assert_close(sample["normals"], vertex_normals(sample["vertices"][None], bars.faces)[0])
    assert data[-1]["set"] == 2
    assert data[-1]["vertices"].shape == (30, 3)
    assert dataset(root, dtype=torch.float64)[0]["vertices"].dtype == torch.float64
    with pytest.raises(IndexError, match="24 of 24"):
        data[24]
    # Key-frames take turns as starts, over epochs too.
    starts = [data[i]["keyframe"] for i in range(PER_SET)]
    data.set_epoch(1)
    starts += [data[i]["keyframe"] for i in range(PER_SET)]
    assert starts == [i % 3 for i in range(2 * PER_SET)]


def test_samples_without_transforms_are_the_key_frames(root: Path, bars: Shapes) -> None:
    """Those with transforms: tests/data/test_motion.py."""
    still = tm.ShapeDataset(root, tm.RandomInBetween(p=0.0), samples_per_set=3, dtype=torch.float64)
    for i in range(3):
        assert torch.equal(still[i]["vertices"], bars.keyframes[i])


def test_a_sample_depends_on_seed_epoch_and_index_alone(root: Path) -> None:
    data = dataset(root)
    first = data[5]["vertices"]
    data.__getitems__([7, 3, 11])
    assert torch.equal(data[5]["vertices"], first)
    assert torch.equal(dataset(root)[5]["vertices"], first)
    together = data.__getitems__([20, 5, 1])[1]["vertices"]
    torch.testing.assert_close(together, first, rtol=0, atol=1e-4)
    others = [data[6]["vertices"], dataset(root, seed=5)[5]["vertices"]]
    data.set_epoch(1)
    others.append(data[5]["vertices"])
    for other in others:
        assert not torch.equal(other, first)


@pytest.mark.parametrize(("workers", "method"), [(1, "fork"), (2, "fork"), (2, "spawn")])
def test_workers_change_nothing(root: Path, workers: int, method: str) -> None:
    """Also where the parent has used everything before, with threads of its own."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        data = dataset(root)
        torch.randn(400, 400) @ torch.randn(400, 400)
        expected = batches(data, epochs=2, num_workers=0)
        assert torch.get_num_threads() == 2
        options = {"num_workers": workers, "multiprocessing_context": method, "timeout": 120}
        if method == "fork":
            assert_same(batches(dataset(root), epochs=2, **options), expected)
        assert_same(batches(data, epochs=2, persistent_workers=True, **options), expected)
    finally:
        torch.set_num_threads(threads)


def test_ordinary_loaders_mix_sets_of_one_connectivity(root: Path) -> None:
    data = dataset(root)
    data.sets = data.sets[:2]
    loader = DataLoader(data, batch_size=5, shuffle=True, generator=torch.Generator().manual_seed(0))
    found = list(loader)
    assert [len(batch["vertices"]) for batch in found] == [5, 5, 5, 1]
    assert any(len(batch["set"].unique()) == 2 for batch in found)
    alone = {tuple(data[i]["vertices"][0].tolist()): i for i in range(len(data))}
    assert len(alone) == len(data)
    first = torch.tensor(list(alone))
    rows = torch.cat([batch["vertices"][:, 0] for batch in found])
    distances = torch.cdist(rows, first)
    assert float(distances.amin(1).max()) < 1e-4
    assert sorted(distances.argmin(1).tolist()) == list(range(len(data)))


LOADERS: dict[str, Callable[..., DataLoader]] = {
    "sampler": lambda data, **options: DataLoader(data, batch_sampler=SetBatchSampler(data, 3), **options),
    "plain": lambda data, **options: DataLoader(data, 3, collate_fn=list, **options),
    "subset": lambda data, **options: DataLoader(Subset(data, range(len(data))), 3, collate_fn=list, **options),
}
WORKERS: dict[str, dict[str, Any]] = {
    "none": {},
    "two": {"num_workers": 2, "timeout": 120},
    "two that persist": {"num_workers": 2, "timeout": 120, "persistent_workers": True},
}


N_TURNED = 8
"""Samples of :func:`turned`."""


def turned(root: Path) -> tm.ShapeDataset:
    """Two sets with a transform that costs little."""
    return tm.ShapeDataset(root / "deep", tm.RandomRigidMotion(p=1.0), samples_per_set=N_TURNED // 2, seed=4)


def vertices_of(batches: Iterable[Any]) -> list[torch.Tensor]:
    """Of all samples, in the order of their loader."""
    return [
        x
        for batch in batches
        for x in (batch["vertices"] if isinstance(batch, dict) else [s["vertices"] for s in batch])
    ]


def repeats(epochs: Sequence[Sequence[torch.Tensor]]) -> int:
    """Number of samples that equal another one, of this or another epoch."""
    every = [x for epoch in epochs for x in epoch]
    return len(every) - len({x.numpy().tobytes() for x in every})


@pytest.mark.parametrize("kind", LOADERS)
def test_each_iteration_is_a_new_epoch(root: Path, kind: str) -> None:
    """Four passes of loops that never set it: no sample comes twice, and any workers give the same from one seed."""
    found = {}
    for name, options in WORKERS.items():
        loader = LOADERS[kind](turned(root), **options)
        found[name] = [vertices_of(loader) for _ in range(4)]
        assert repeats(found[name]) == 0
    for other in found.values():
        for one, its in zip(found["none"], other, strict=True):
            assert all(torch.equal(x, y) for x, y in zip(one, its, strict=True))


@pytest.mark.parametrize("kind", LOADERS)
@pytest.mark.parametrize("workers", WORKERS)
def test_a_chosen_epoch_is_the_next_iterations(root: Path, kind: str, workers: str) -> None:
    data = turned(root)
    loader = LOADERS[kind](data, **WORKERS[workers])
    first = [vertices_of(loader) for _ in range(2)]
    assert data.epoch == 1
    data.set_epoch(0)
    again = [vertices_of(loader) for _ in range(2)]
    assert all(torch.equal(x, y) for one, its in zip(first, again, strict=True) for x, y in zip(one, its, strict=True))


def test_iterations_side_by_side_keep_to_their_epochs(root: Path) -> None:
    """Of one that was not finished, and with workers that draw ahead."""
    data, expected = turned(root), turned(root)
    whole = [vertices_of(LOADERS["sampler"](expected)) for _ in range(2)]
    loader = LOADERS["sampler"](data, **WORKERS["two"])
    older = iter(loader)
    first = vertices_of([next(older)])
    newer = vertices_of(loader)
    for found, its in zip((first + vertices_of(older), newer), whole, strict=True):
        assert all(torch.equal(x, y) for x, y in zip(found, its, strict=True))


def test_a_dataset_is_iterated_itself(root: Path) -> None:
    data = turned(root)
    one, other = ([sample["vertices"] for sample in data] for _ in range(2))
    assert len(one) == len(data) and repeats([one, other]) == 0
    assert data.epoch == 1 and torch.equal(data[5]["vertices"], other[5]) and torch.equal(data[5]["vertices"], other[5])


def recorder(lightning: Any) -> Any:
    """A module of Lightning that keeps what it is trained on."""

    class Recorder(lightning.LightningModule):
        def __init__(self) -> None:
            super().__init__()
            self.scale = torch.nn.Parameter(torch.ones(()))
            self.epochs: list[list[torch.Tensor]] = []

        def on_train_epoch_start(self) -> None:
            self.epochs.append([])

        def training_step(self, batch: Any, _: int) -> torch.Tensor:
            self.epochs[-1].extend(vertices_of([batch]))
            return self.scale * vertices_of([batch])[0].square().mean()

        def configure_optimizers(self) -> torch.optim.Optimizer:
            return torch.optim.SGD(self.parameters(), 0.01)

    return Recorder()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", LOADERS)
@pytest.mark.parametrize("workers", WORKERS)
def test_a_trainer_of_lightning_has_new_samples_in_each_epoch(root: Path, kind: str, workers: str) -> None:
    lightning = pytest.importorskip("lightning")
    runs = []
    for _ in range(2):
        module = recorder(lightning)
        options = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
        trainer = lightning.Trainer(max_epochs=4, accelerator="cpu", **options)
        trainer.fit(module, LOADERS[kind](turned(root), **WORKERS[workers]))
        assert [len(epoch) for epoch in module.epochs] == 4 * [N_TURNED] and repeats(module.epochs) == 0
        runs.append([x for epoch in module.epochs for x in epoch])
    assert all(torch.equal(x, y) for x, y in zip(*runs, strict=True))


def test_batches_of_one_set(root: Path) -> None:
    data = dataset(root)
    sampler = SetBatchSampler(data, 3)
    drawn = list(sampler)
    assert len(drawn) == len(sampler) == N_SETS * 3
    assert sorted(index for batch in drawn for index in batch) == list(range(len(data)))
    assert all(len({index // PER_SET for index in batch}) == 1 for batch in drawn)
    assert list(sampler) != drawn
    data.set_epoch(0)
    assert list(sampler) == drawn
    assert list(SetBatchSampler(data, 3, shuffle=False))[:4] == [[0, 1, 2], [3, 4, 5], [6, 7], [8, 9, 10]]
    with pytest.raises(ValueError, match="batch_size"):
        SetBatchSampler(data, 0)


def label_poses(stored: StoredSet) -> dict[str, torch.Tensor]:
    classes = {"straight": 0, "bent": 1, "twisted": 2}
    part = torch.arange(stored.n_vertices) % 4
    return {"vertex_labels": part, "shape_labels": torch.eye(3)[[classes[name] for name in stored.names]]}


def test_labels_from_a_function(root: Path) -> None:
    transform = tm.RandomInBetween(p=1.0, blend_labels=True)
    with pytest.raises(ValueError, match="blended labels must be floating-point"):
        tm.ShapeDataset(root, transform, labels=label_poses)[0]
    hard = tm.ShapeDataset(root, tm.RandomInBetween(p=1.0), labels=label_poses, samples_per_set=PER_SET)
    for sample in hard.__getitems__(list(range(len(hard)))):
        assert torch.equal(sample["vertex_labels"], torch.arange(len(sample["vertices"])) % 4)
        assert sorted(sample["shape_labels"].tolist()) == [0, 0, 1]
    soft = tm.ShapeDataset(root, transform, labels=soft_poses, samples_per_set=PER_SET)
    batch = default_collate(soft.__getitems__(list(range(PER_SET))))
    torch.testing.assert_close(batch["shape_labels"].sum(1), torch.ones(PER_SET))
    assert float(batch["shape_labels"].amax(1).min()) < 0.9
    assert_same(batches(soft, num_workers=1, multiprocessing_context="spawn"), batches(soft))


def soft_poses(stored: StoredSet) -> dict[str, torch.Tensor]:
    return {"shape_labels": label_poses(stored)["shape_labels"]}


def test_labels_of_each_key_frame(bars: Shapes, tmp_path: Path) -> None:
    """From a file in the folder of the set, which is the user's."""
    tm.write_set(tmp_path / "set", *bars, ["0", "1", "2"])
    per_keyframe = torch.arange(3)[:, None].repeat(1, 164)
    save_file({"vertex_labels": per_keyframe, "shape_labels": torch.tensor([4, 5, 6])}, tmp_path / "set" / "labels")
    transform = tm.RandomModalDeformation(p=1.0)
    data = tm.ShapeDataset(
        tmp_path, transform, samples_per_set=3, labels=lambda stored: load_file(stored.folder / "labels")
    )
    for k in range(3):
        assert data[k]["shape_labels"] == 4 + k
        assert data[k]["vertex_labels"].unique().tolist() == [k]
    with pytest.raises(ValueError, match=r"set: vertex_labels begin with the shape \(3, 164\).*got \(163,\)"):
        tm.ShapeDataset(tmp_path, labels=lambda _: {"vertex_labels": torch.zeros(163)})[0]


def test_tables_of_members_are_kept_in_the_folders(bars: Shapes, tmp_path: Path) -> None:
    tm.write_set(tmp_path / "set", *bars, ["0", "1", "2"])
    blend = tm.RandomBlend(p=1.0, members=2)
    first = batches(tm.ShapeDataset(tmp_path, blend))
    path = tmp_path / "set" / "between-all.safetensors"
    written = path.stat().st_mtime_ns
    assert_same(batches(tm.ShapeDataset(tmp_path, blend)), first)
    assert path.stat().st_mtime_ns == written
    for other in (tm.RandomBlend(p=1.0, members=3), tm.RandomBlend(p=1.0, members=2, locality=1.0)):
        before = path.read_bytes()
        tm.ShapeDataset(tmp_path, other)[0]
        assert path.read_bytes() != before
    # Damaged ones are made again; where nothing can be written, nothing is.
    path.write_bytes(path.read_bytes()[:-100])
    assert_same(batches(tm.ShapeDataset(tmp_path, blend)), first)
    path.unlink()
    assert_same(batches(tm.ShapeDataset(tmp_path, blend, folder=None)), first)
    assert not path.exists()


def test_tables_of_other_faces_or_versions_are_not_read(
    bars: Shapes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file is exchanged for zeros under the same key: whoever reads it is found out."""
    path = tmp_path / "between-all.safetensors"

    def table(faces: torch.Tensor = bars.faces) -> torch.Tensor:
        return tm.ShapeSpace(bars.keyframes, faces, folder=tmp_path).members(2, 0.2, 3.0, (0.0, 0.0))

    right = table()
    key = TensorFile(path, FORMAT, VERSION).metadata

    def plant() -> None:
        write_tensors(path, FORMAT, VERSION, {"shapes": torch.zeros_like(right)}, key)

    plant()
    assert float(table().abs().max()) == 0
    assert float(table(bars.faces.roll(1, 1)).abs().max()) > 1
    plant()
    monkeypatch.setattr("torch_modal.data.in_betweens.__version__", "0.0.1")
    assert torch.equal(table(), right)


def test_what_does_not_converge_is_warned_of(bars: Shapes, tmp_path: Path) -> None:
    hasty = tm.Solver(max_steps=0, tolerance=1e-12, local_steps=0)
    tm.write_set(tmp_path / "set", *bars, ["0", "1", "2"])
    between = tm.RandomInBetween(t=(0.4, 0.6), p=1.0)
    data = tm.ShapeDataset(tmp_path, between, preset="modal", solver=hasty, samples_per_set=3)
    with pytest.warns(tm.ConvergenceWarning, match=r"1 of 1 in-betweens near the key-frames . and . "):
        data[0]
    space = tm.ShapeSpace(bars.bases, bars.faces, preset="modal", solver=hasty)
    x = bars.keyframes + 0.01 * torch.sin(bars.keyframes)
    with pytest.warns(tm.ConvergenceWarning, match="did not converge"):
        between(x, space=space)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert bool(tm.ShapeDataset(tmp_path, between)[0]["vertices"].isfinite().all())
        between(x, space=tm.ShapeSpace(bars.bases, bars.faces))


def test_sets_with_one_key_frame(bars: Shapes, tmp_path: Path) -> None:
    tm.write_set(tmp_path / "one", bars.keyframes[:1], bars.faces, bars.bases[:1], ["0"])
    data = tm.ShapeDataset(tmp_path, everything(p=1.0), samples_per_set=2)
    assert bool(data[1]["vertices"].isfinite().all())
    with pytest.raises(ValueError, match="one key-frame alone does not vary"):
        tm.ShapeDataset(tmp_path)[0]
    data = tm.ShapeDataset(tmp_path, tm.RandomInBetween(p=1.0))
    assert torch.equal(data[0]["vertices"], bars.keyframes[0].float())


def labels_of_keyframes(stored: StoredSet) -> dict[str, torch.Tensor]:
    return {"shape_labels": torch.arange(len(stored.keyframes))}


def test_the_default_mixes_all_key_frames_and_refuses_labels_that_differ(bars: Shapes, tmp_path: Path) -> None:
    tm.write_set(tmp_path / "set", *bars, ["0", "1", "2"])
    x = tm.ShapeDataset(tmp_path)[0]["vertices"]
    assert all(float((x - key).abs().max()) > 1e-3 for key in bars.keyframes)
    with pytest.raises(ValueError, match="labels differ between its key-frames"):
        tm.ShapeDataset(tmp_path, labels=labels_of_keyframes)[0]
    assert tm.ShapeDataset(tmp_path, tm.RandomInBetween(), labels=labels_of_keyframes)[0]["shape_labels"] in range(3)


def test_only_the_last_sets_stay_open(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch_modal.data.dataset.OPEN_SETS", 2)

    def spaces() -> int:
        gc.collect()
        return sum(type(each) is tm.ShapeSpace for each in gc.get_objects())

    before = spaces()  # of other tests
    data = dataset(root)
    for i in (0, PER_SET, 2 * PER_SET, 0):
        data[i]
        assert len(data._opened._kept) <= 2
        assert spaces() <= before + 2
    assert len(pickle.dumps(data)) < 4000


def test_what_a_dataset_refuses(root: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no stored key-frame set in"):
        tm.ShapeDataset(tmp_path)
    with pytest.raises(FileNotFoundError, match="no folder"):
        tm.ShapeDataset(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="samples_per_set"):
        tm.ShapeDataset(root, samples_per_set=0)
    for seed in (-1, 1.5, None):
        with pytest.raises(ValueError, match=f"seed is an integer, 0 or more; got {seed}"):
            tm.ShapeDataset(root, seed=seed)  # type: ignore[arg-type]
