"""Fixtures that several test files share; everything made once per run."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

from torch_modal.precompute.tetrahedra import Tetrahedra, TetrahedraSettings, tetrahedralize

COARSE = TetrahedraSettings(edge_length_fac=0.08, epsilon=5e-3)


@pytest.fixture(scope="session", autouse=True)
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The run's own cache: nothing is taken from the user's, and nothing left there."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCH_MODAL_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Scanned and modelled meshes, which are not part of the project."""
    folder = Path(__file__).parents[1].parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the folder {folder} with larger meshes is not there")
    return folder


@pytest.fixture(scope="session")
def capsule() -> tuple[np.ndarray, np.ndarray]:
    """A limb-like closed surface, its axis along z and not in the origin: vertices (V, 3), faces (F, 3)."""
    mesh = trimesh.creation.capsule(height=3.0, radius=0.6, count=(12, 12))
    mesh.merge_vertices()
    assert mesh.is_volume
    return np.array(mesh.vertices) + np.array([0.5, -0.2, 1.0]), np.array(mesh.faces, dtype=np.int64)


@pytest.fixture(scope="session")
def capsule_tetrahedra(capsule: tuple[np.ndarray, np.ndarray]) -> Tetrahedra:
    """The capsule filled by the real mesher, once per run: few enough vertices for dense linear algebra."""
    return tetrahedralize(*capsule, COARSE)
