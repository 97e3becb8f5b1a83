"""The documentation's site: it builds without a warning, and has every page and every public name in it."""

import ast
import inspect
import pydoc
import re
import shutil
import subprocess
import sys
import zlib
from functools import cache
from pathlib import Path
from types import ModuleType

import nbformat
import pytest
from helpers.snippets import PAGES, ROOT, blocks, run_python
from nbclient import NotebookClient
from test_examples import load_example

import torch_modal as tm
from torch_modal.cli.main import COMMANDS, build_parser
from torch_modal.completion.complete import Completion
from torch_modal.data.shape_batch import ShapeBatch
from torch_modal.elastic.minimise import Solution, Status
from torch_modal.modes.lattice import Lattice
from torch_modal.modes.tetwild import TetWild
from torch_modal.registration.report import Registration
from torch_modal.statistics.components import Components
from torch_modal.statistics.fit import Fitted

DOCS = ROOT / "docs"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


@pytest.fixture(scope="module")
def extension() -> ModuleType:
    return load_example("../docs/extension")


# ----------------------------------------------------------------------------------------------------------- pages
def test_every_public_name_has_a_page(extension: ModuleType) -> None:
    floors = extension.public_names()
    names = [name for each in floors.values() for name in each]
    assert sorted(names) == sorted(tm.__all__) and len(set(names)) == len(names)
    listed = re.findall(r"^api/(\w+)$", (DOCS / "api.md").read_text(), re.M)
    assert sorted(floors) == sorted(listed) == sorted(path.stem for path in (DOCS / "api").glob("*.md"))
    for floor in floors:
        assert f"```{{public-names}} {floor}\n" in (DOCS / "api" / f"{floor}.md").read_text()


def test_the_pages_explain_every_public_name() -> None:
    text = "\n".join(page.read_text() for page in PAGES)
    assert [name for name in tm.__all__ if not re.search(rf"\b{name}\b", text)] == []
    assert len(tm.__all__) <= 50


def test_the_pages_begin_with_the_word_that_people_look_for() -> None:
    for page in (ROOT / "README.md", DOCS / "start.md"):
        assert "subdivide" not in page.read_text().partition("tm.interpolate")[0]


def test_every_page_is_in_a_list(extension: ModuleType) -> None:
    """By hand in index.md, or else by itself."""
    listed, unlisted = extension.listed_pages(), extension.unlisted_pages()
    assert not listed & set(unlisted)
    there = {path.stem for path in DOCS.glob("*.md")} | {f"notebooks/{path.stem}" for path in NOTEBOOKS}
    assert listed | set(unlisted) == there - {"index", "README"}


def test_every_command_and_benchmark_is_shown(extension: ModuleType) -> None:
    assert {"interpolate", "view", "demo"} <= set(extension.command_helps())
    shown = extension.benchmarks()
    assert {"quality.py", "speed.py", "motion.py"} <= set(shown)
    for name in re.findall(r"`(\w+\.py)`", (DOCS / "benchmarks.md").read_text()):
        assert name in shown, name


# ------------------------------------------------------------------------------------------- what the pages speak of
TABLES = {
    **{("extending", "member"): tm.Term, ("registration", "field"): Registration},
    **{("completion", "`Completion`"): Completion, ("layer", "`Status`"): Status},
}
"""Classes whose members the first column of a table names, by page and heading; others are headed ``tm.NAME``."""
VARIABLES: dict[str, type] = {
    **{"space": tm.ShapeSpace, "layer": tm.InBetween, "editor": tm.PathEditor, "passengers": tm.Passengers},
    **{"augment": tm.AugmentationSequential, "components": Components, "fitted": Fitted, "solution": Solution},
}
"""Names by which the pages call objects of the package in running text."""


OTHERS = {
    *("min", "sqrt", "net", "fullgraph", "collate_fn", "DeprecationWarning"),  # of Python and torch
    *("Data", "Meshes", "face", "pos"),  # of PyTorch Geometric and PyTorch3D
    *("seek", "positionOf", "placeOf"),  # of the page's script
}
"""Functions and arguments in inline code that are no public names of the package."""


def has_member(owner: type, name: str) -> bool:
    """Members of a class, and attributes that its methods set."""
    sources = [inspect.getsource(each) for each in owner.__mro__ if each.__module__.startswith("torch_modal.")]
    own = rf"self\.{name}\b.* = |^    {name}: |register_buffer\(\"{name}\""
    return hasattr(owner, name) or any(re.search(own, source, re.M) for source in sources)


def options() -> dict[str, set[str]]:
    """Options of each command, and of all of them together with those of the scripts as ``""``."""
    (commands,) = (action.choices for action in build_parser()._actions if isinstance(action.choices, dict))
    found = {name: set(parser._option_string_actions) for name, parser in commands.items()}
    scripts = [*(ROOT / "tests" / "benchmarks").glob("*.py"), *(ROOT / "examples").rglob("*.py")]
    words = [word for file in scripts for word in re.findall(r'"(--[a-z][\w-]*)"', file.read_text())]
    return {**found, "": set(words).union(*found.values())}


def missing(text: str, page: str = "") -> set[str]:
    """Commands, options, public names, members and files that a page names and that do not exist."""
    known, found = options(), set()
    for command, rest in re.findall(r"torch-modal ([a-z][\w-]*)([^`#\n]*)", text.replace("\\\n", " ")):
        if command in COMMANDS:
            wrong = set(re.findall(r"(?<!\S)--[a-z][\w-]*", rest)) - known[command]
            found |= {f"torch-modal {command} {option}" for option in wrong}
        else:
            found.add(f"torch-modal {command}")
    found |= set(re.findall(r"`(--[a-z][\w-]*)", text)) - known[""]
    for name in re.findall(r"\b(?:tm|torch_modal)((?:\.[A-Za-z_]\w*)+)", text):
        if pydoc.locate(f"torch_modal{name}") is None:
            found.add(f"tm{name}")
    for path, test in re.findall(r"(?<![\w./-])((?:torch_modal|tests|examples|docs)/[\w./-]*\w)(?:::(\w+))?", text):
        if not (ROOT / path).exists() or (test and f"def {test}(" not in (ROOT / path).read_text()):
            found.add(f"{path}::{test}" if test else path)
    files = "\n".join(file.as_posix() for file in ROOT.rglob("*.py")) + "\n"
    found |= {path for path in re.findall(r"`((?:\w+/)*\w+\.py)\b", text) if f"/{path}\n" not in files}
    for variable, member in re.findall(r"`(\w+)\.(?!py\b)([A-Za-z_]\w*)", text):
        owner = VARIABLES.get(variable) or getattr(tm, variable, None) or {"Solution": Solution}.get(variable)
        if inspect.isclass(owner) and not has_member(owner, member):
            found.add(f"{variable}.{member}")
    for heading, rows in re.findall(r"^\| ([^|\n]+) \|.*\n\|[-|]+\|\n((?:\|.*\n)+)", text, re.M):
        match = re.match(r"`tm\.(\w+)`", heading)
        owner = getattr(tm, match[1]) if match else TABLES.get((page, heading))
        for cells in (row.split("|") for row in rows.splitlines()):
            names = re.findall(r"`([A-Za-z_]\w*)[^`]*`", cells[1])
            if heading == "folder":
                named = [f"{names[0]}/{name}" for name in re.findall(r"`(\w+(?:\.py|/))`", cells[2])]
                found |= {name for name in named if not (ROOT / "torch_modal" / name).exists()}
            elif owner:
                found |= {f"{owner.__name__}.{name}" for name in names if not has_member(owner, name)}
    return found


@cache
def vocabulary() -> tuple[set[str], set[str]]:
    """Public names, their methods and arguments; and all words of the package, the examples and the tests."""
    public = (
        [getattr(tm, name) for name in tm.__all__] + list(vars(tm.losses).values()) + [Lattice, TetWild, ShapeBatch]
    )
    members = [getattr(each, name) for each in public if inspect.isclass(each) for name in dir(each) if name[0] != "_"]
    called = [each for each in [*public, *members] if "torch_modal" in str(getattr(each, "__module__", ""))]
    called = [each for each in called if callable(each) and not (inspect.isclass(each) and issubclass(each, Exception))]
    defined = {each.__name__ for each in called}.union(*(inspect.signature(each).parameters for each in called))
    files = [*ROOT.glob("torch_modal/**/*.[pj][ys]"), *ROOT.glob("examples/**/*.py"), *ROOT.glob("tests/**/*.py")]
    return defined, set(re.findall(r"\w+", "\n".join(file.read_text(encoding="utf-8") for file in files)))


def unknown(text: str) -> set[str]:
    """Functions, arguments and names in inline code that neither the package nor the page itself has."""
    defined, words = vocabulary()
    code = "\n".join(re.findall(r"^```.*?^```", text, re.M | re.S))
    spans = re.findall(r"(?<!`)`([^`]+)`(?!`)", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))
    mine = set(re.findall(r"\w+", code)) | OTHERS
    strict = {name for span in spans for name in re.findall(r"(?<![\w.\[])([A-Za-z][^\W_]\w*)(?:\(|=(?!=))", span)}
    plain = {span for span in spans if re.fullmatch(r"[A-Za-z_]\w{2,}", span) and span[1] != "_"}
    return (strict - defined - mine) | (plain - words - mine)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_a_page_names_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert missing(text, page.stem) | unknown(text) == set()


def test_what_does_not_exist_is_found() -> None:
    text = """
`torch-modal compress a.obj`, `torch-modal view --linear --lines` and `--faster`; tm.InBetween and `tm.Between` of
torch_modal.layers.in_betwixt, tm.losses.Shell, `tests/project/test_docs.py::test_nothing`, `examples/walk.py`,
`elastic/minimize.py`, `elastic/minimise.py`, `space.sample(3)`, `space.samples` and `Solution.state`.

| member | meaning |
|---|---|
| `weights(edge_vectors)`, `blocks` | |

| `tm.Solver`: how |
|---|
| `max_steps=80`, `min_steps=1` |

| folder | contents |
|---|---|
| `elastic/` | `implicit.py`, `explicit.py` |
"""
    assert missing(text, "extending") == {
        *("torch-modal compress", "torch-modal view --lines", "--faster", "tm.Between", "tm.losses.Shell"),
        *("tm.layers.in_betwixt", "tests/project/test_docs.py::test_nothing", "examples/walk.py"),
        *("elastic/minimize.py", "elastic/explicit.py", "space.samples", "Solution.state", "Term.blocks"),
        *("Solver.min_steps", "explicit.py"),
    }
    text = "`RandomBlend(member=3)`, `RandomMixture(members=3)`, `subdivide`, `torch.lerp(a, b)`, `contacts=True`"
    assert unknown(text) == {"member", "RandomMixture", "contacts"}


def test_the_first_block_of_readme_runs_in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):  # a second run replaces what the first has written
        run_python(blocks(ROOT / "README.md")[0], names := {})
    assert names["frames"].shape == (17, 3782, 3) and [file.name for file in tmp_path.iterdir()] == ["grasp.glb"]


def test_the_front_page_does_not_scroll_sideways() -> None:
    """Its column has 88 characters; formulas of other pages scroll by themselves."""
    lines = [line for block in blocks(ROOT / "README.md") for line in block.text.splitlines()]
    assert len(lines) > 30 and max(map(len, lines)) <= 88
    assert re.search(r"div\.math \{[^}]*overflow-x: auto", (DOCS / "_static" / "site.css").read_text())


# -------------------------------------------------------------------------------------------------------- messages
def messages() -> list[re.Pattern[str]]:
    """All texts with holes of the package, as patterns."""
    found = []
    for path in Path(tm.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr) and len(node.values) > 1:
                parts = [re.escape(p.value) if isinstance(p, ast.Constant) else ".*" for p in node.values]  # type: ignore[arg-type]
                found.append(re.compile("".join(parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value) > 20:
                found.append(re.compile(re.escape(node.value)))
    return found


def test_words_are_those_of_the_field() -> None:
    """Edge vectors, capped faces, trajectories, active contacts, tangent offsets: no other names for the same."""
    other = re.compile(r"\b(?:spokes?|walls|told|held|excess|(?<!of )course)\b", re.IGNORECASE)
    files = [*(ROOT / "torch_modal").rglob("*.py"), *DOCS.rglob("*.md"), ROOT / "README.md"]
    found = [(file.name, line) for file in files for line in file.read_text().splitlines() if other.search(line)]
    assert not found


def test_class_names_are_unique() -> None:
    names = [
        name
        for file in (ROOT / "torch_modal").rglob("*.py")
        for name in re.findall(r"^class ([A-Za-z]\w*)", file.read_text(), re.M)
    ]
    assert sorted(names) == sorted(set(names))


def test_messages_of_the_questions_are_those_of_the_package() -> None:
    known = [pattern for pattern in messages() if len(pattern.pattern.replace(".*", "")) > 20]
    quoted = [" ".join(block.text.split()) for block in blocks(DOCS / "faq.md") if block.language == "text"]
    assert len(quoted) > 10
    for text in quoted:
        assert any(pattern.fullmatch(text) for pattern in known), f"the package does not say: {text}"


# ------------------------------------------------------------------------------------------------------- notebooks
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_small_and_were_run(path: Path) -> None:
    assert path.stat().st_size < 150_000
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert outputs and all(output.output_type != "error" for output in outputs)
    assert "/" + "home" not in path.read_text() and len(NOTEBOOKS) == 2


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run(path: Path, tmp_path: Path) -> None:
    """From end to end, in a folder without the repository; each asserts what it shows in its last cell."""
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        cell.source = cell.source.replace("for seed in range(2)", "for seed in range(1)")  # of the training
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()


# ------------------------------------------------------------------------------------------------------------ site
@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as docs/build.sh makes it, of a copy with one page more."""
    root = tmp_path_factory.mktemp("repository")
    shutil.copytree(DOCS, root / "docs", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "tests" / "benchmarks", root / "tests" / "benchmarks")
    for name in ("README.md", "setup.py"):
        shutil.copy(ROOT / name, root)
    (root / "docs" / "added.md").write_text("# A page that nobody listed\n\nSee [the layer](solving.md#gradients).\n")
    (root / "tests" / "environment.sh").write_text(f"python='{sys.executable}'\n")  # is there already
    command = ["sh", str(root / "docs" / "build.sh"), "--version", "--quiet"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-5000:]
    pages = root / "out" / "docs" / tm.__version__
    assert f'href="{tm.__version__}/index.html"' in (pages.parent / "index.html").read_text()
    return pages


@pytest.mark.slow
def test_site_has_every_page_and_name(site: Path) -> None:
    lines = (site / "objects.inv").read_bytes().split(b"\n", 4)
    inventory = zlib.decompress(lines[4]).decode().splitlines()
    documented = {line.split()[0] for line in inventory if " py:" in line}
    assert {f"torch_modal.{name}" for name in tm.__all__} <= documented
    assert {"torch_modal.InBetween.solve", "torch_modal.ModalBasis.save"} <= documented
    index = (site / "index.html").read_text()
    for path in [*DOCS.glob("*.md"), *NOTEBOOKS]:
        page = path.relative_to(DOCS).with_suffix(".html")
        if path.stem not in {"index", "README"}:
            assert (site / page).exists() and f'href="{page}"' in index, page
    assert 'href="added.html"' in index
    assert "A page that nobody listed" in (site / "added.html").read_text()


@pytest.mark.slow
def test_gallery_has_pages_of_shapes(site: Path) -> None:
    frames = re.findall(r'<iframe src="([^"]+)"', (site / "gallery.html").read_text())
    assert len(frames) == 2
    for frame in frames:
        page = (site / frame).read_text()
        assert 300_000 < len(page) < 3_000_000 and "torchModal" in page


@pytest.mark.slow
def test_links_within_the_site_lead_somewhere(site: Path) -> None:
    for page in [*site.glob("*.html"), *site.glob("notebooks/*.html"), *site.glob("api/*.html")]:
        text = page.read_text()
        for link in re.findall(r'(?:href|src)="([^"#?]+)[^"]*"', text):
            if not re.match(r"[a-z]+:|//", link):
                assert (page.parent / link).resolve().exists(), f"{page.name}: {link}"


@pytest.mark.slow
def test_site_needs_no_network(site: Path) -> None:
    """Scripts, styles, fonts, pictures and formulas are all within."""
    elsewhere = re.compile(
        r"""src=["'](?:https?:)?//|<link[^>]+href=["'](?:https?:)?//|url\(["']?(?:https?:)?//|@import"""
    )
    for page in [*site.rglob("*.html"), *site.rglob("*.css")]:
        assert all("canonical" in match[0] for match in elsewhere.finditer(page.read_text())), page.name
    theory = (site / "theory.html").read_text()
    assert (
        theory.count("<math") > 50 and "\\frac" not in theory and "$" not in re.sub("<script.*?</script>", "", theory)
    )
