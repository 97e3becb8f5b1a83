"""What the site says of the package by itself: names, commands, benchmarks, pages of shapes, unlisted pages."""

from __future__ import annotations

import argparse
import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import nested_parse_with_titles
from sphinx.writers.html5 import HTML5Translator

import torch_modal as tm
from torch_modal.motion.subdivide import keyframe_places
from torch_modal.times import fill_linear

DOCS = Path(__file__).parent
PACKAGE = Path(tm.__file__).parent
HERE = "<!-- unlisted pages -->"
"""The line of index.md in whose place pages stand that no list has."""


def parsed(directive: SphinxDirective, lines: list[str], markdown: bool = False) -> list[nodes.Node]:
    """Text in the place of a directive of a Markdown page; that of docstrings is reStructuredText."""
    node = nodes.section()
    node.document = directive.state.document
    text = lines if markdown else ["```{eval-rst}", *lines, "```"]
    nested_parse_with_titles(directive.state, StringList(text, source=directive.env.docname), node)
    return node.children


# ----------------------------------------------------------------------------------------------------------- names
def public_names() -> dict[str, list[str]]:
    """Public names by the floor that they come from, ``"root"`` for those of none, in the order of the stub."""
    found: dict[str, list[str]] = {}
    for node in ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            floor = (node.module or "").split(".")[0]
            floor = floor if (PACKAGE / floor).is_dir() and floor else "root"
            for alias in node.names:
                found.setdefault(alias.name if node.module is None else floor, []).append(alias.name)
    return found


def directive_for(name: str) -> list[str]:
    """The autodoc directive of a public name."""
    value = getattr(tm, name)
    if inspect.ismodule(value):
        return [f".. automodule:: torch_modal.{name}", "   :members:", "   :imported-members:", ""]
    if inspect.isclass(value):
        kind = "exception" if issubclass(value, BaseException) else "class"
        bases = [] if value.__bases__ == (object,) else ["   :show-inheritance:"]
        return [f".. auto{kind}:: torch_modal.{name}", "   :members:", *bases, ""]
    if callable(value):
        return [f".. autofunction:: torch_modal.{name}", ""]
    lines = described_at_home(name)
    return [".. py:currentmodule:: torch_modal", f".. py:data:: {name}", "", *(f"   {line}" for line in lines), ""]


def described_at_home(name: str) -> list[str]:
    """The text below a public value in the module that it comes from; elsewhere Python knows no text of it."""
    for node in ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and name in {alias.name for alias in node.names}:
            analyzer = ModuleAnalyzer.for_module(f"torch_modal.{node.module}")
            return analyzer.find_attr_docs()["", name]
    raise KeyError(name)


class PublicNames(SphinxDirective):
    """``{public-names} nn``: all names of a floor, documented; ``all``: a list of links to every one."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The documentation of the names, or the list."""
        self.env.note_dependency(str(PACKAGE / "__init__.pyi"))
        wanted, names = self.arguments[0], public_names()
        if wanted == "all":
            return parsed(self, list(self._index(names)), markdown=True)
        if wanted not in names:
            raise self.error(f"there is no floor {wanted!r} with public names; there are {', '.join(names)}")
        return parsed(self, [line for name in names[wanted] for line in directive_for(name)])

    @staticmethod
    def _index(names: dict[str, list[str]]) -> Iterator[str]:
        for floor, its_names in names.items():
            yield f"- [](api/{floor}.md): " + ", ".join(f"[`{name}`](#torch_modal.{name})" for name in its_names)


def literal_blocks(lines: list[str]) -> list[str]:
    """Indented blocks of docstrings are equations or examples, as in Markdown: they are shown as they stand."""
    result: list[str] = []
    literal = False
    for number, line in enumerate(lines):
        begins = line.startswith("    ") and (number > 0 and not lines[number - 1].strip())
        before = next((other for other in reversed(lines[:number]) if other.strip()), "")
        if begins and not literal and before and not before.startswith((" ", "- ", "* ", "..")):
            result += ["::", ""] if not before.rstrip().endswith("::") else []
            literal = True
        elif line.strip() and not line.startswith(" "):
            literal = False
        result.append(line)
    return result


def suit_napoleon(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Our docstrings as napoleon reads them.

    It would take what stands before a colon at the beginning of a result or an attribute for its type.
    """
    found = [re.sub(r"\*(Shapes?[^*]*):\*", r"\1", line) for line in literal_blocks(lines)]
    first = 0 if what in {"attribute", "property", "data"} else None
    for number in [first, *(n + 1 for n, line in enumerate(found[:-1]) if line.strip() == "Returns:")]:
        if number is not None and found:
            found[number] = re.sub(r"^([^:`]*):(?= |$)", r"\1 –", found[number])
    lines[:] = found


# -------------------------------------------------------------------------------------------------------- commands
def command_helps() -> dict[str, str]:
    """What ``torch-modal COMMAND --help`` says, by command."""
    from torch_modal.cli.main import build_parser

    parser = build_parser()
    (commands,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    return {
        each.prog.split()[-1]: each.format_help() for each in commands.choices.values()
    }  # an alias is no second one


class CommandHelp(SphinxDirective):
    """``{command-help}``: a section for each command."""

    def run(self) -> list[nodes.Node]:
        """The sections."""
        found: list[nodes.Node] = []
        for name, text in command_helps().items():
            section = nodes.section(ids=[nodes.make_id(name)], names=[name])
            section += nodes.title("", f"torch-modal {name}")
            section += nodes.literal_block(text, text, language="none", classes=["command-help"])
            found.append(section)
        return found


# ------------------------------------------------------------------------------------------------------ benchmarks
def benchmarks() -> dict[str, str]:
    """What each benchmark says of itself, by the name of its file."""
    found = {}
    for path in sorted((DOCS.parent / "tests" / "benchmarks").glob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        text = ast.get_docstring(tree)
        if text and f"python tests/benchmarks/{path.name}" in text:
            found[path.name] = text
    return found


class BenchmarkList(SphinxDirective):
    """``{benchmark-list}``: a section for each benchmark, with its command."""

    def run(self) -> list[nodes.Node]:
        """The sections."""
        found: list[nodes.Node] = []
        for name, text in benchmarks().items():
            section = nodes.section(ids=[nodes.make_id(name)], names=[name])
            section += nodes.title("", name)
            section += parsed(self, literal_blocks(text.splitlines()))
            found.append(section)
        return found


# ----------------------------------------------------------------------------------------------------------- pages
def listed_pages() -> set[str]:
    """Pages that a list in index.md names."""
    text = (DOCS / "index.md").read_text(encoding="utf-8")
    lists = re.findall(r"^```\{toctree\}\n(.*?)^```", text, re.M | re.S)
    entries = {line.strip() for each in lists for line in each.splitlines() if line.strip() and line[0] != ":"}
    return {re.sub(r"^.*<(.+)>$", r"\1", entry) for entry in entries}  # with a title of its own, or without


def unlisted_pages() -> list[str]:
    """Pages that lie in docs/ and in no list: they get one of their own."""
    there = {path.stem for path in DOCS.glob("*.md")} - {"index", "README"}
    return sorted(there - listed_pages())


def list_unlisted(app: Sphinx, page: str, source: list[str]) -> None:
    """A page that somebody adds is on the site without any further word."""
    if page == "index":
        pages = "\n".join(unlisted_pages())
        listing = f"```{{toctree}}\n:caption: More\n:hidden:\n\n{pages}\n```" if pages else ""
        source[0] = source[0].replace(HERE, listing)


def readme() -> str:
    """README as the front page: it needs no second one."""
    return (DOCS.parent / "README.md").read_text(encoding="utf-8").partition("\n")[2]


def follow_links(app: Sphinx, page: str, source: list[str]) -> None:
    """Links of the repository's pages lead to those of the site, or else to the repository."""
    setup = (DOCS.parent / "setup.py").read_text(encoding="utf-8")
    repository = re.search(r'^REPOSITORY = "(.+)"', setup, re.M)
    assert repository is not None

    def followed(match: re.Match[str]) -> str:
        path = match[1]
        if path.startswith("README.md"):
            return f"](index.md{path.removeprefix('README.md')})"
        return f"]({path[5:]})" if path.startswith("docs/") else f"]({repository[1]}/blob/HEAD/{path})"

    if page == "index":
        # As seen from the repository's root. Where a link shows the name of a file, the site shows a page's title.
        text = re.sub(
            r"\]\((?!https?:|mailto:|#)([^)\s]+)\)", followed, re.sub(r"\[docs/[\w/.-]+\]\(", "[](", readme())
        )
        source[0] = source[0].replace("<!-- README -->", text)
    elif "/" not in page:
        source[0] = re.sub(r"\]\(\.\./([^)\s]+)\)", followed, source[0])


def write_inline_math(translator: HTML5Translator, node: nodes.math) -> None:
    """A formula as MathML, which browsers draw without a script and without a network."""
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def write_math_block(translator: HTML5Translator, node: nodes.math_block) -> None:
    """The same, on lines of its own."""
    translator.body.append(f'<div class="math">{convert(node.astext(), display="block")}</div>')
    raise nodes.SkipNode


def always_index(app: Sphinx, *_: Any) -> list[str]:
    """What is unlisted may have changed although index.md has not."""
    return ["index"]


def write_shape_pages(app: Sphinx) -> None:
    """The pages of the gallery: the samples between their key-frames, beside linear interpolation and the truth."""
    if app.builder.format != "html":
        return
    from torch_modal.data.samples import SAMPLES, load_sample

    folder = Path(app.outdir) / "shapes"
    folder.mkdir(parents=True, exist_ok=True)
    newest = max(path.stat().st_mtime for path in PACKAGE.rglob("*") if path.suffix in {".py", ".js", ".css", ".ply"})
    for name in SAMPLES:
        page = folder / f"{name}.html"
        if page.exists() and page.stat().st_mtime > newest:
            continue
        sample = load_sample(name)
        levels = 2 if sample.cyclic else 4
        places = keyframe_places(len(sample.keyframes), levels=levels, cyclic=sample.cyclic)
        bases = tm.extract_bases(sample.keyframes, sample.faces, progress=False)
        rows = {
            "torch_modal": tm.interpolate(
                sample.keyframes, sample.faces, levels=levels, bases=bases, cyclic=sample.cyclic, progress=False
            ),
            "linear": fill_linear(sample.keyframes, places),
        }
        page.unlink(missing_ok=True)
        keys = places[:-1] if sample.cyclic else places
        shown = tm.show(
            rows,
            sample.faces,
            keyframe_indices=keys,
            fps=2**levels * 6,
            cyclic=sample.cyclic,
            view=sample.view,
            title=f"torch_modal: {name}",
        )
        shown.save(page)


def setup(app: Sphinx) -> dict[str, bool]:
    """Tell Sphinx of all this."""
    app.add_html_math_renderer("mathml", (write_inline_math, None), (write_math_block, None))
    app.add_directive("public-names", PublicNames)
    app.add_directive("command-help", CommandHelp)
    app.add_directive("benchmark-list", BenchmarkList)
    app.connect("autodoc-process-docstring", suit_napoleon, priority=400)  # before napoleon
    app.connect("source-read", list_unlisted)
    app.connect("source-read", follow_links)
    app.connect("env-get-outdated", always_index)
    app.connect("builder-inited", write_shape_pages)
    return {"parallel_read_safe": True}
