"""A coarse carrier in the place of a fine mesh: key-frames, detail, distance to the whole solve."""

from pathlib import Path

import pytest
import torch
import trimesh
from conftest import Shapes
from helpers.shapes import edge_lengths
from torch import Tensor

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.io.write import save_mesh
from torch_modal.motion.subdivide import keyframe_places
from torch_modal.passengers.proxy import Proxy, proxy_size


@pytest.fixture(scope="module")
def rough(bars: Shapes) -> tuple[Tensor, Tensor]:
    """The bars with 2,594 vertices and a relief. *Shape:* ``(3, V, 3)``, ``(F, 3)``."""
    faces, shapes = bars.faces.numpy(), [x.numpy() for x in bars.keyframes]
    for _ in range(2):
        finer = [trimesh.remesh.subdivide_loop(x, faces, 1) for x in shapes]
        shapes, faces = [x for x, _ in finer], finer[0][1]
    height = 0.02 * torch.sin(20 * torch.from_numpy(shapes[0])).prod(1)[:, None].numpy()
    normals = [trimesh.Trimesh(x, faces, process=False).vertex_normals for x in shapes]
    return torch.stack([torch.from_numpy(x + height * n) for x, n in zip(shapes, normals, strict=True)]), (
        torch.from_numpy(faces)
    )


def test_key_frames_come_back_and_shapes_are_near_those_of_the_whole(rough: tuple[Tensor, Tensor]) -> None:
    keyframes, faces = rough
    whole, carried = (
        tm.subdivide(keyframes, faces, 1, n_modes=8, preset="fast", proxy=n, progress=False) for n in (0, 300)
    )
    assert carried.shape == whole.shape == (5, *keyframes.shape[1:])
    assert torch.equal(carried[::2], keyframes)
    size = float((keyframes[0].amax(0) - keyframes[0].amin(0)).norm())
    assert float((carried - whole).norm(dim=-1)[1::2].mean()) < 3e-3 * size
    lengths = [edge_lengths(x, faces) for x in (keyframes, carried, whole)]
    wanted = 0.5 * (lengths[0][:-1] + lengths[0][1:])
    carried_error, whole_error = (float((x[1::2] / wanted - 1).abs().mean()) for x in lengths[1:])
    assert carried_error < 1.3 * whole_error


def test_cycles_and_numbers_of_frames(rough: tuple[Tensor, Tensor]) -> None:
    keyframes, faces = rough
    options = {"n_modes": 8, "preset": "fast", "proxy": 300, "progress": False}
    cycle = tm.subdivide(keyframes, faces, 1, cyclic=True, **options)
    assert len(cycle) == 6 and torch.equal(cycle[::2], keyframes)
    single = tm.subdivide(keyframes.float(), faces, 1, n_frames=8, **options)
    places = keyframe_places(3, 1, n_frames=8)
    assert single.dtype == torch.float32 and torch.equal(single[places], keyframes.float())


def test_detail_is_that_of_both_ends(rough: tuple[Tensor, Tensor]) -> None:
    keyframes, faces = rough
    proxy = Proxy(keyframes[:2], faces, 300)
    for passengers, carrier, x in zip(proxy.passengers, proxy.keyframes, keyframes, strict=False):
        torch.testing.assert_close(passengers(carrier), x, rtol=0, atol=1e-12)
    # From the first to the last, and from there, as in a cycle, to the first.
    found = proxy.carry(proxy.keyframes[[0, 0, 0, 0]], [0, 2, 4], keyframes[:2])
    own, other = (passengers(proxy.keyframes[0]) for passengers in proxy.passengers)
    torch.testing.assert_close(found[[1, 3]], 0.5 * (own + other).expand(2, -1, -1))


@pytest.mark.parametrize("proxy", [-1, 20, 0.5])
def test_sizes_of_a_proxy_that_are_refused(bars: Shapes, proxy: float) -> None:
    with pytest.raises(ValueError, match="at least 100"):
        tm.subdivide(bars.keyframes, bars.faces, proxy=proxy)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="bases belong to the whole mesh"):
        tm.subdivide(bars.keyframes, bars.faces, bases=bars.bases, proxy=120)
    assert [proxy_size(None, n) for n in (100_000, 100_001)] == [0, 20_000]


def test_the_command(rough: tuple[Tensor, Tensor], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keyframes, faces = rough
    meshes = save_mesh(keyframes[:2].numpy(), faces.numpy(), tmp_path, fmt="obj", stem="key")
    options = ["--modes", "6", "--levels", "1", "--preset", "fast", "--proxy", "300", "--out", str(tmp_path / "out")]
    assert cli.main(["subdivide", *map(str, meshes), *options]) == 0
    assert "moved by a proxy of about 300" in capsys.readouterr().out
    frames = tm.load_keyframes(sorted((tmp_path / "out").glob("frame-*.obj"))).keyframes
    assert len(frames) == 3
    torch.testing.assert_close(frames[[0, 2]], keyframes[:2], rtol=1e-8, atol=1e-8)  # OBJ has nine digits


def test_each_vertex_follows_its_own_part() -> None:
    """Of two spheres, one just within the other, where facets of the outer reach below the inner."""
    ball = trimesh.creation.icosphere(3)
    x, faces = torch.from_numpy(ball.vertices.copy()), torch.from_numpy(ball.faces.copy())
    both = torch.cat([x, 0.995 * x])
    proxy = Proxy(both[None], torch.cat([faces, faces + len(x)]), 150)
    piece = torch.tensor(Connectivity(proxy.faces.numpy()).vertex_pieces)
    inner = piece != piece[proxy.keyframes[0].norm(dim=1).argmax()]
    moved = proxy.keyframes[0] + torch.tensor([0.0, 0.0, 5.0]) * inner[:, None]
    found = proxy.passengers[0](moved) - both
    torch.testing.assert_close(found[: len(x)], torch.zeros_like(x), rtol=0, atol=1e-9)
