"""Imports go one way, and what is heavy is loaded by those who need it only.

import-linter would hold the first half; the second, and the one door to the backends, need the parsed imports anyway.
"""

import ast
import graphlib
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "torch_modal"

# From the ground up: a module imports from its own floor and lower ones, at the top of the file or inside functions.
FLOORS = [
    "version",
    "arrays",
    "errors",
    "extras",
    "progress",
    "trees",
    "autograd",
    "threads",
    "times",
    "geometry",
    "io",
    "keyframes",
    "elastic",
    "modes",
    "inbetween",
    "contact",
    "layers",
    "passengers",
    "registration",
    "motion",
    "statistics",
    "completion",
    "losses",
    "codec",
    "data",
    "view",
    "",
    "cli",
    "__main__",
]
MODULES = sorted(
    str(path.relative_to(PACKAGE).with_suffix("")).replace("/", ".").removesuffix("__init__").removesuffix(".")
    for path in PACKAGE.rglob("*.py")
)
LAYERS = {"elastic", "inbetween", "layers"}
FOREIGN_TO_LAYERS = set("numpy scipy fast_simplification trimesh pytetwild tqdm pyvista matplotlib pygltflib".split())


@cache
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
    return {re.sub(r"^torch_modal(\.|$)", "", name) for name in found}


def own(module: str) -> set[str]:
    return {name for name in imported(module) if name in MODULES}


def floor(module: str) -> int:
    return FLOORS.index(module.split(".")[0])


def test_every_module_has_its_floor() -> None:
    assert {module.split(".")[0] for module in MODULES} == set(FLOORS)
    assert "modes.extract" in own("motion.subdivide"), "imports are not seen"
    assert "geometry.inspect" in own("registration.maps"), "from torch_modal.geometry import inspect is not seen"


def test_imports_go_down() -> None:
    upwards = [
        f"{module or '__init__'} imports {name}, on a higher floor"
        for module in MODULES
        for name in sorted(own(module))
        if floor(name) > floor(module)
    ]
    assert not upwards


def test_no_imports_go_round() -> None:
    graphlib.TopologicalSorter({module: own(module) - {module} for module in MODULES}).prepare()


def test_modes_are_without_torch() -> None:
    """Besides the basis: ``extract.py`` alone makes tensors, for ``basis.py``."""
    rooms = {module: {name.split(".")[0] for name in imported(module)} for module in MODULES}
    with_torch = {module for module in MODULES if module.startswith("modes.") and "torch" in rooms[module]}
    assert with_torch == {"modes.basis", "modes.extract"}


def test_layers_are_torch_only() -> None:
    """Bases are what comes in; only the coarse mesh and segments, made once on the host, use more."""
    allowed = {"inbetween.coarse": {"modes.coarsening"}, "inbetween.regions": {"numpy"}}
    allowed["inbetween.free_vertices"] = {"numpy", "scipy"}  # sparse factors
    allowed["elastic.rest_hessian"] = {"numpy", "scipy"}
    # What kernels are given once comes in arrays of the host, which are NumPy's for Warp.
    allowed["elastic.crossings"] = {"numpy", "scipy"}
    foreign = {
        (module, name)
        for module in MODULES
        if module.split(".")[0] in LAYERS
        for name in {found if found in MODULES else found.split(".")[0] for found in imported(module)}
        if name in FOREIGN_TO_LAYERS or (name.startswith("modes.") and name != "modes.basis")
        if name not in allowed.get(module, ())
    }
    assert not foreign


def test_one_door_leads_to_the_kernels() -> None:
    """No other room names Warp or its kernels, or asks which backend it has; the setting of its name is one."""
    asks = re.compile(r"\bwarp\b|\.kernels\b|isinstance\([^)]*backend|backend(\.name)? *(==|!=| is )", re.I)
    paths = {str(path.relative_to(PACKAGE)): path for path in PACKAGE.rglob("*.py")}
    found = {name for name, path in paths.items() if name.split("/")[0] != "elastic" and asks.search(path.read_text())}
    assert found == {"inbetween/settings.py"}


def test_one_lock_guards_the_decimation() -> None:
    """fast-simplification is not thread-safe."""
    users = [name for name in MODULES if "fast_simplification" in imported(name)]
    assert users == ["geometry.decimation"]


def test_import_loads_nothing_heavy() -> None:
    heavy = ["pyvista", "vtk", "matplotlib", "pygltflib", "pytetwild", "torch._dynamo"]
    heavy += ["scipy.interpolate", "sympy", "warp"]
    code = (
        "import sys, torch_modal; torch_modal.extract_bases, torch_modal.subdivide, torch_modal.InBetween; "
        "from torch_modal.keyframes.arrays import broadcast_leading; "
        "assert broadcast_leading(x=(2, 1), y=(3,), t=()) == (2, 3); "
        f"print([name for name in {heavy} if name in sys.modules])"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120, cwd=PACKAGE.parent)
    assert done.stdout == "[]\n"


def test_public_names_are_there() -> None:
    import torch_modal

    assert sorted(torch_modal.__all__) == torch_modal.__all__
    for name in torch_modal.__all__:
        assert getattr(torch_modal, name) is not None
    fixed = "load_keyframes extract_modes extract_bases ModalBasis ShellEnergy GaussNewtonStep MidShape subdivide"
    assert set(fixed.split()) <= set(torch_modal.__all__)
