"""Packaging of torch_modal; build-system and tool tables stand in pyproject.toml."""

import re
from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).parent
VERSION = re.search(r'^__version__ = "(.+)"', (ROOT / "torch_modal/version.py").read_text(), re.M).group(1)

setup(
    name="torch_modal",
    version=VERSION,
    description="Physically plausible in-between shapes from key-frame meshes, in a space of vibration modes",
    long_description=(ROOT / "README.md").read_text(),
    long_description_content_type="text/markdown",
    license="MIT",
    python_requires=">=3.10",
    packages=find_packages(include=["torch_modal", "torch_modal.*"]),
    package_data={"torch_modal": ["py.typed", "*.pyi", "nn/*.pyi", "samples/*/*.ply", "view/page_assets/*"]},
    install_requires=[
        "torch>=2.4",
        "numpy>=1.24",
        "scipy>=1.11",
        "trimesh>=4.6.13",  # earlier ones lose the mesh of some files
        "networkx>=3.0",
        "pytetwild[all]>=0.4.2",
        "fast-simplification>=0.1.11",
        "kornia>=0.8.2",
        "safetensors>=0.4.3",
        "pygltflib>=1.16",
        "matplotlib>=3.7",
        "threadpoolctl>=3.1",
        "tqdm>=4.65",
        "lazy_loader>=0.4",
    ],
    extras_require={
        "pyg": ["torch_geometric>=2.4"],
        "view": ["viser>=1.0"],
        "dask": ["distributed>=2024.5"],
        "test": [
            "pytest>=8",
            "ruff>=0.6",
            "mypy>=1.11",
            "torch_geometric>=2.4",
            "distributed>=2024.5",
            "selenium>=4.20",
            "viser>=1.0",
        ],
    },
    entry_points={"console_scripts": ["torch-modal = torch_modal.cli.main:main"]},
)
