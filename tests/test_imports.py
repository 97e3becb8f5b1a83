"""Imports go one way, and what is heavy is loaded by those who need it only."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "torch_modal"

# From the ground up: a module may import those in earlier lines only, at the top of the file or inside functions.
ORDER = [
    ["version", "errors", "files", "mesh", "inspect_mesh", "processes", "sparse_solve"],
    ["arrays", "basis", "export", "mesh_files", "rigid"],
    ["drawing"],
    ["keyframes", "picture", "stored"],
    ["precompute", "precompute._tetwild_worker", "precompute.cache", "precompute.coarsening", "precompute.parallel"],
    ["precompute.surface", "precompute.mass"],
    ["precompute.lanczos"],
    ["precompute.tetrahedra", "precompute.eigen"],
    ["precompute.arap", "precompute.lattice"],
    ["precompute.embedding", "precompute.carrying"],
    ["precompute.filling"],
    ["precompute.solving"],
    ["precompute.modes"],
    ["nn", "nn.shell"],
    ["nn.curvature", "nn.linearised", "nn.rotations"],
    ["nn.modal_shell"],
    ["nn.surface"],
    ["nn.frame", "nn.gauss_newton", "nn.blend", "nn.guess"],
    ["nn.joint", "nn.paired", "nn.implicit"],
    ["nn.between"],
    ["nn.in_between"],
    ["nn.mid_shape", "full_space"],
    ["sequence"],
    ["augment", "augment.triangles", "augment.table", "augment.normals"],
    ["augment.reconstruction"],
    ["augment.space"],
    ["augment.base"],
    ["augment.between", "augment.deformation", "augment.rigid_motion"],
    ["augment.sequential"],
    ["adapters", "dataset", "pyg"],
    ["sample_data"],
    [""],
    ["demo"],
    ["bulk", "bulk.records", "bulk.sharing", "bulk.tree"],
    ["bulk._set_worker", "bulk.progress", "bulk.review", "bulk.set_process"],
    ["bulk.run"],
    ["bulk.command"],
    ["commands"],
    ["cli"],
]
RANK = {name: rank for rank, names in enumerate(ORDER) for name in names}
MODULES = sorted(
    str(path.relative_to(PACKAGE).with_suffix("")).replace("/", ".").removesuffix("__init__").removesuffix(".")
    for path in PACKAGE.rglob("*.py")
)
FOREIGN_TO_LAYERS = set("scipy fast_simplification trimesh pytetwild tqdm pyvista matplotlib pygltflib".split())


def imported(module: str) -> set[str]:
    """Every module that a file imports, anywhere in it; of this package without its name."""
    folder = PACKAGE / module.replace(".", "/")
    path = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} has a relative import"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                within = whole.removeprefix("torch_modal.")
                found.add(whole if within in MODULES and within != whole else str(node.module))
    return {name.removeprefix("torch_modal").removeprefix(".") if is_own(name) else name for name in found}


def is_own(name: str) -> bool:
    return name == "torch_modal" or name.startswith("torch_modal.")


def own(module: str) -> set[str]:
    return {name for name in imported(module) if name in RANK}


def test_every_module_has_its_place() -> None:
    assert set(MODULES) <= set(RANK), f"give {sorted(set(MODULES) - set(RANK))} a line in ORDER"
    assert "precompute.modes" in own("sequence"), "imports are not seen"
    assert "mesh" in own("nn.frame"), "from torch_modal import mesh is not seen"


@pytest.mark.parametrize("module", MODULES, ids=lambda name: name or "torch_modal")
def test_imports_go_one_way(module: str) -> None:
    backwards = sorted(name for name in own(module) if RANK[name] >= RANK[module])
    assert not backwards, f"{module or '__init__'} imports {backwards}, which stand no lower"


@pytest.mark.parametrize("module", [name for name in MODULES if name.startswith("precompute")])
def test_precompute_does_not_know_the_layers(module: str) -> None:
    assert not {name for name in own(module) if name.startswith("nn")}
    if module not in ("precompute", "precompute.modes"):
        assert "torch" not in {name.split(".")[0] for name in imported(module)}, "modes.py alone makes tensors"


@pytest.mark.parametrize("module", [name for name in MODULES if name.startswith("nn")])
def test_layers_are_torch_only(module: str) -> None:
    packages = {name.split(".")[0] for name in imported(module)}
    assert not packages & FOREIGN_TO_LAYERS
    if module not in ("nn.curvature", "nn.frame", "nn.blend"):
        assert "numpy" not in packages
    # Only the frame, made once, looks into the other room.
    allowed = {"precompute.coarsening"} if module == "nn.frame" else set()
    assert {name for name in own(module) if name.startswith("precompute")} <= allowed


def test_import_loads_nothing_heavy() -> None:
    heavy = ["pyvista", "vtk", "matplotlib", "pygltflib", "pytetwild", "torch_geometric"]
    code = f"import sys, torch_modal; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120, cwd=PACKAGE.parent
    )
    assert result.stdout.strip() == "[]"


def test_public_names_are_there() -> None:
    import torch_modal

    assert sorted(torch_modal.__all__) == torch_modal.__all__
    for name in torch_modal.__all__:
        assert getattr(torch_modal, name) is not None
    fixed = "load_keyframes extract_modes extract_bases ModalBasis ShellEnergy GaussNewtonStep MidShape subdivide"
    assert set(fixed.split()) <= set(torch_modal.__all__)
