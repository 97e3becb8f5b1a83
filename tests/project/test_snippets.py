"""Every snippet of README and of the documentation runs as it is written.

The blocks of a page run in their order, in a folder with the files that ``examples/write_meshes.py`` writes: Python in
one namespace, ``torch-modal`` in this process. Of other commands it is checked that what they name is there. A block
that is not run says so, and why, in the line before it: ``*Not run by the tests: it needs Blender.*``
"""

import inspect
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import torch
from helpers.shapes import coarsened
from helpers.snippets import COMMAND, LANGUAGES, NOT_RUN, PAGES, ROOT, Block, blocks, commands, expanded, run_python
from test_examples import load_example

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.data.samples import Sample, load_sample
from torch_modal.io.formats import ANIMATION_FORMATS, MESH_FORMATS

QUICK = {"layer", "viewing"}
"""Pages that are tried in the default run; what others cost is not known beforehand."""
WITH_CODE = [
    pytest.param(page, id=page.stem, marks=[pytest.mark.slow] * (page.stem not in QUICK))
    for page in PAGES
    if any(block.language in {"python", "sh"} and block.is_run for block in blocks(page))
]


def load_small_sample(name: str) -> Sample:
    """The creature has half of its vertices; those of the hand have their numbers in the pages."""
    sample = load_sample(name)
    if name == "hand":
        return sample
    n = len(sample.keyframes)
    x, faces = coarsened(torch.cat([sample.keyframes, sample.truth]), sample.faces, 4800)
    return sample._replace(keyframes=x[:n], truth=x[n:], faces=faces)


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, example = tmp_path_factory.mktemp("meshes"), load_example("write_meshes")
    with patch.object(example, "load_sample", load_small_sample):
        example.main(folder)
    return folder


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    """Formats that a page registers are gone after it."""
    with patch.dict(MESH_FORMATS), patch.dict(ANIMATION_FORMATS):
        yield


def content(value: Any) -> Any:
    """What tells arguments of a call apart."""
    if isinstance(value, torch.Tensor):
        return value.dtype, value.tolist()
    if isinstance(value, (list, tuple)):
        return [content(each) for each in value]
    return [content(each) for each in vars(value).items()] if isinstance(value, tm.Observation) else value


def computed_once(call: Callable[..., Any]) -> Callable[..., Any]:
    """A function that keeps its results: commands of a page, and its Python, ask for the same ones."""
    known: dict[str, Any] = {}

    def keeping(*given: Any, **options: Any) -> Any:
        bound = inspect.signature(call).bind(*given, **options)
        given_ones = {name: content(value) for name, value in bound.arguments.items() if name != "progress"}
        key = repr({name: value for name, value in given_ones.items() if value not in (None, False)})
        if key not in known:
            known[key] = call(*given, **options)
        return known[key]

    return keeping


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_block_says_what_it_is(page: Path) -> None:
    """So that none is left out by its form."""
    for block in blocks(page):
        if block.language == "":
            assert not COMMAND.match(block.text) and "import " not in block.text, f"{block}: fence it as sh or python"
        else:
            assert block.language in LANGUAGES or block.language.startswith("{"), str(block)
    said = len(re.findall(rf"^\*{NOT_RUN}", page.read_text(encoding="utf-8"), re.M))
    assert said == sum(not block.is_run for block in blocks(page)), "a mark that belongs to no block, or has no reason"


@pytest.mark.parametrize("page", WITH_CODE)
def test_blocks_run_in_their_order(page: Path, meshes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first in an empty folder: it needs no file that the page makes, or names, later."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("webbrowser.open", lambda url: True)
    monkeypatch.setattr(tm, "load_sample", load_small_sample)
    monkeypatch.setattr(tm, "complete", computed_once(tm.complete))  # a minute each
    names: dict[str, object] = {"__name__": "__main__"}
    first, *others = (block for block in blocks(page) if block.language in {"python", "sh"})
    assert first.is_run
    run_block(first, names, meshes)
    shutil.copytree(meshes, tmp_path, dirs_exist_ok=True)
    for block in others:
        if block.is_run:
            run_block(block, names, meshes)


def run_block(block: Block, names: dict[str, object], meshes: Path) -> None:
    if block.language == "python":
        run_python(block, names)
        return
    for words in commands(block):
        run_command(block, words, meshes)


def run_command(block: Block, words: list[str], meshes: Path) -> None:
    """Run ``torch-modal``, and copy what ``write_meshes.py`` has written; of all else, check that it could be run."""
    program, *arguments = words
    if words[-1].endswith("write_meshes.py"):
        shutil.copytree(meshes, Path(), dirs_exist_ok=True)
    elif Path(program).name == "torch-modal":
        try:
            status = cli.main(expanded(arguments))
        except SystemExit as end:  # --help
            status = end.code
        # What crosses is an answer too.
        assert status in ({0, 3} if arguments[0] == "check" else {0}), f"{block}: {' '.join(words)}"
    elif program == "pip":
        extras = re.findall(r"\[(.+?)\]", " ".join(arguments))
        known = re.findall(r'^    "(\w+)": \[', (ROOT / "setup.py").read_text(), re.M)
        assert set(",".join(extras).split(",")) <= {*known, "all", ""}, str(block)
    else:
        assert Path(program).name in {"python", "sh"}, f"{block}: {program}"
        files = (arguments[0], "tests/benchmarks/methods.py", "tests/benchmarks/results.py")  # --peer-python, --keep
        script = "".join((ROOT / file).read_text() for file in files)
        for option in (word for word in arguments[1:] if word.startswith("--")):
            assert f'"{option}"' in script or arguments[0].endswith(".sh"), f"{block}: {option}"
