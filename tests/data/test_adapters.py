"""Graphs: the same shapes as from plain tensors."""

from pathlib import Path

import pytest
import torch
from conftest import Shapes

import torch_modal as tm

F64 = torch.float64


@pytest.fixture(scope="module")
def space(bars: Shapes) -> tm.ShapeSpace:
    return tm.ShapeSpace(bars.bases, bars.faces, dtype=F64)


@pytest.mark.parametrize("n", [1, 3])
def test_graphs(bars: Shapes, space: tm.ShapeSpace, n: int) -> None:
    """A graph, and a batch of graphs, are transformed as their shapes would be; what came stays."""
    geometric = pytest.importorskip("torch_geometric", reason="PyTorch Geometric is not installed")
    from torch_geometric.transforms import Compose, FaceToEdge

    from torch_modal.data.pyg import RandomShape

    face, normal = bars.faces.T.contiguous(), torch.zeros(164, 3, dtype=F64)
    graphs = [
        geometric.data.Data(pos=x, face=face, normal=normal, x=torch.arange(164), y=torch.eye(3)[i : i + 1])
        for i, x in enumerate(bars.keyframes[:n])
    ]
    data = geometric.data.Batch.from_data_list(graphs) if n > 1 else graphs[0]

    def make() -> tm.AugmentationSequential:
        return tm.AugmentationSequential(
            tm.RandomInBetween(p=1.0, blend_labels=True),
            tm.RandomModalDeformation(p=1.0),
            generator=torch.Generator().manual_seed(2),
            space=space,
        )

    transform = RandomShape(make(), y=torch.eye(3))
    found = Compose([transform, FaceToEdge(remove_faces=False)])(data)
    assert torch.equal(data.pos, bars.keyframes[:n].flatten(0, 1)), "the graph that came has changed"
    assert found.edge_index.shape[0] == 2
    assert torch.equal(found.x, data.x) and torch.equal(found.face, data.face)
    expected = make()(bars.keyframes[:n], pool=tm.ShapeBatch.of_keyframes(space, data.pos))
    torch.testing.assert_close(found.pos, expected.flatten(0, 1))
    torch.testing.assert_close(found.normal, tm.vertex_normals(expected, bars.faces).flatten(0, 1))
    assert found.y.shape == (n, 3)
    torch.testing.assert_close(found.y.diagonal(), 1 - transform.augmentation.params[0]["t"].float())
    assert "RandomInBetween" in repr(transform)

    alone = RandomShape(tm.RandomModalDeformation(p=1.0), space=space)
    moved = alone(data)
    assert torch.equal(moved.y, data.y)
    assert not torch.equal(moved.pos, data.pos)


def test_graphs_that_do_not_fit(space: tm.ShapeSpace) -> None:
    geometric = pytest.importorskip("torch_geometric", reason="PyTorch Geometric is not installed")
    from torch_modal.data.pyg import RandomShape

    transform = RandomShape(tm.RandomModalDeformation(), space=space)
    one, *uneven = (geometric.data.Data(pos=torch.zeros(n, 3, dtype=F64)) for n in (30, 100, 228))
    for data, message in (
        (one, r"1 graphs of this space has the shape \(164, 3\).*; got \(30, 3\)"),
        (geometric.data.Batch.from_data_list(uneven), r"2 graphs of this space has the shape \(328, 3\)"),
    ):
        with pytest.raises(ValueError, match=message):
            transform(data)
    with pytest.raises(ValueError, match="needs key-frames"):
        RandomShape(tm.RandomModalDeformation())


def test_graphs_from_the_dataset(bars: Shapes, tmp_path: Path) -> None:
    geometric = pytest.importorskip("torch_geometric", reason="PyTorch Geometric is not installed")
    from torch_modal.data.pyg import as_data

    tm.write_set(tmp_path / "a", *bars, ["0", "1", "2"])
    data = tm.ShapeDataset(tmp_path, samples_per_set=3, faces=True, normals=True, labels=graph_labels)
    graphs = [as_data(sample) for sample in data.__getitems__([0, 1, 2])]
    batch = geometric.data.Batch.from_data_list(graphs)
    assert batch.pos.shape == batch.normal.shape == (3 * 164, 3)
    assert torch.equal(batch.face[:, 324:648].T - 164, bars.faces)
    assert batch.y.shape == (3,)
    assert torch.equal(batch.vertex_labels, torch.arange(164).repeat(3))
    torch.testing.assert_close(graphs[1].pos, data[1]["vertices"])


def graph_labels(stored: tm.StoredSet) -> dict[str, torch.Tensor]:
    return {"vertex_labels": torch.arange(stored.n_vertices), "shape_labels": torch.arange(len(stored))}
