"""Packaging of torch_modal; build-system and tool tables stand in pyproject.toml."""

import re
from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).parent
VERSION = re.search(r'^__version__ = "(.+)"', (ROOT / "torch_modal/version.py").read_text(), re.M).group(1)

# libigl's AABB tree came to Python with 2.6.
REGISTER = ["robust_laplacian>=1.0", "potpourri3d>=1.2", "libigl>=2.6", "threadpoolctl>=3.1"]

setup(
    name="torch_modal",
    version=VERSION,
    description="Physically plausible in-between shapes from key-frame meshes, in a space of vibration modes",
    long_description=(ROOT / "README.md").read_text(),
    long_description_content_type="text/markdown",
    license="MIT",
    python_requires=">=3.10",
    packages=find_packages(include=["torch_modal", "torch_modal.*"]),
    package_data={"torch_modal": ["py.typed", "*.pyi", "samples/*/*.ply"]},
    install_requires=[
        "torch>=2.4",
        "numpy>=1.24",
        "scipy>=1.11",
        "trimesh>=4.6.13",  # earlier ones lose the mesh of some files
        "networkx>=3.0",
        "pytetwild[all]>=0.4.2",
        "fast-simplification>=0.1.11",
        # Before 0.9, its rotation matrices are right to 1e-6 only; 0.9 has no release for Python 3.10.
        "kornia>=0.9; python_version >= '3.11'",
        "kornia>=0.8.2; python_version < '3.11'",
        "safetensors>=0.4.3",
        "pygltflib>=1.16",
        "matplotlib>=3.7",
        "tqdm>=4.65",
        "lazy_loader>=0.4",
    ],
    extras_require={
        "pyg": ["torch_geometric>=2.4"],
        "register": REGISTER,
        "test": [*REGISTER, "pytest>=8", "ruff>=0.6", "mypy>=1.11", "torch_geometric>=2.4"],
    },
    entry_points={"console_scripts": ["torch-modal = torch_modal.cli.main:main"]},
)
