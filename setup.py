"""Packaging of torch_modal; build-system and tool tables stand in pyproject.toml."""

import re
from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).parent
VERSION = re.search(r'^__version__ = "(.+)"', (ROOT / "torch_modal/version.py").read_text(), re.M).group(1)
REPOSITORY = "https://github.com/torch-modal/torch_modal"
"""The one place that names it; a fork changes it here."""


def description_for_pypi() -> str:
    """README, whose links within the repository PyPI can follow only as whole addresses: of pages, and of pictures."""

    def whole(match: re.Match[str]) -> str:
        path = match.group(1)
        kind = "raw" if path.endswith((".png", ".jpg", ".gif", ".svg")) else "blob"
        return f"]({REPOSITORY}/{kind}/HEAD/{path})"

    return re.sub(r"\]\((?!https?:|mailto:|#)([^)\s]+)\)", whole, (ROOT / "README.md").read_text(encoding="utf-8"))


EXTRAS = {
    "video": ["imageio[ffmpeg]>=2.28"],  # MP4
    "usd": ["usd-core>=24.5"],
    # Caches; there are no wheels for other machines.
    "alembic": [
        "alembic3d>=1.8.12 ; (sys_platform != 'darwin' and platform_machine in 'x86_64 AMD64')"
        " or (sys_platform == 'darwin' and platform_machine == 'arm64')"
    ],
    "vtk": ["pyvista>=0.47"],  # surfaces of medical images and simulations
    # Meshes of different connectivity; libigl's AABB tree came to Python with 2.6.
    "register": ["robust_laplacian>=1.0", "potpourri3d>=1.2", "libigl>=2.6"],
    "contact": ["libigl>=2.6.3"],  # parts that pass through each other
    "dask": ["distributed>=2024.5"],
}
HAS_WARP = (
    "(sys_platform == 'linux' and (platform_machine == 'x86_64' or platform_machine == 'aarch64'))"
    " or (sys_platform == 'darwin' and platform_machine == 'arm64')"
    " or (sys_platform == 'win32' and platform_machine == 'AMD64')"
)
# The site: sh docs/build.sh
DOCS = ["sphinx>=7.4", "furo>=2024.8", "myst-nb>=1.1", "sphinx-copybutton>=0.5", "latex2mathml>=3.77"]

setup(
    name="torch_modal",
    version=VERSION,
    description="Physically plausible in-between shapes from key-frame meshes, in a space of vibration modes",
    long_description=description_for_pypi(),
    long_description_content_type="text/markdown",
    author="torch_modal contributors",
    license="MIT",
    license_files=["LICENSE"],
    url=REPOSITORY,
    project_urls={
        "Documentation": f"{REPOSITORY}/tree/HEAD/docs",
        "Changelog": f"{REPOSITORY}/blob/HEAD/CHANGELOG.md",
        "Issues": f"{REPOSITORY}/issues",
    },
    keywords=[
        *["mesh", "shape interpolation", "in-betweening", "key-frames", "animation", "vibration modes"],
        *["differentiable", "geometry processing", "data augmentation", "pytorch"],
    ],
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Developers",
        "Intended Audience :: Science/Research",
        "Operating System :: OS Independent",
        "Programming Language :: Python :: 3",
        "Programming Language :: Python :: 3 :: Only",
        *[f"Programming Language :: Python :: 3.{minor}" for minor in (10, 11, 12, 13, 14)],
        "Topic :: Multimedia :: Graphics :: 3D Modeling",
        "Topic :: Scientific/Engineering :: Artificial Intelligence",
        "Topic :: Scientific/Engineering :: Mathematics",
        "Typing :: Typed",
    ],
    python_requires=">=3.10",
    packages=find_packages(include=["torch_modal", "torch_modal.*"]),
    package_data={"torch_modal": ["py.typed", "*.pyi", "samples/*/*.ply", "view/page_assets/*"]},
    install_requires=[
        "torch>=2.8",  # earlier ones lack what tells transforms of torch.func apart, or cannot gather by int32 in them
        "numpy>=1.24",
        "scipy>=1.11",
        "trimesh>=4.6.13",  # earlier ones lose the mesh of some files
        "pytetwild>=0.4.2",
        "fast-simplification>=0.1.11",
        # Without wheels for Linux and Windows on ARM, where SciPy solves.
        "cholespy>=2.1; platform_machine in 'x86_64 AMD64' or sys_platform == 'darwin'",
        "kornia>=0.8.2",
        "safetensors>=0.4.3",
        "matplotlib>=3.7",
        "threadpoolctl>=3.1",
        "pillow>=10",
        "tqdm>=4.65",
        "lazy_loader>=0.4",
        # Kernels, where there are wheels.
        f"warp-lang>=1.19 ; {HAS_WARP}",
    ],
    extras_require={
        **EXTRAS,
        "all": sorted({each for extra in EXTRAS.values() for each in extra}),
        "docs": DOCS,
        "test": [
            *sorted({each for extra in EXTRAS.values() for each in extra}),
            *DOCS,
            *[
                "pytest>=8",
                "pytest-xdist>=3.6",
                "ruff>=0.6",
                "mypy>=1.11",
                "pygltflib>=1.16",
                "selenium>=4.20",
                "viser>=1.1",  # examples/live.py
                "h5py>=3.11",
                "lightning>=2.4",  # its Trainer over a data set
            ],
            *["build>=1.2", "twine>=6.1", "check-wheel-contents>=0.6", "setuptools>=77"],
        ],
    },
    entry_points={"console_scripts": ["torch-modal = torch_modal.cli.main:main"]},
)
