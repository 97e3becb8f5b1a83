"""Code blocks of the documentation, and how they are run as they stand."""

from __future__ import annotations

import ast
import re
import shlex
from collections.abc import Iterator
from glob import glob
from pathlib import Path
from typing import Any, NamedTuple

from markdown_it import MarkdownIt

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMAND = re.compile(r"^(\S*/)?(torch-modal|python|python3|pip|sh|sbatch)\s")
"""What a command to be typed begins with."""
NOT_RUN = "Not run by the tests"
LANGUAGES = {"python", "sh", "text", "bibtex"}


class Block(NamedTuple):
    """A block of code of a page."""

    page: Path
    line: int
    language: str
    """As the page says; empty for an indented block."""
    text: str
    before: str
    """The paragraph before it."""

    @property
    def is_run(self) -> bool:
        """Unless the page says, before the block, that it is not, and why."""
        return re.match(rf"\*{NOT_RUN}[^:*]*: \S", self.before) is None

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks(page: Path) -> list[Block]:
    """All blocks of code of a page, in their order."""
    found, before = [], ""
    for token in MarkdownIt().parse(page.read_text(encoding="utf-8")):
        if token.type == "inline":
            before = token.content
        elif token.type in {"fence", "code_block"}:
            language = token.info.split()[0] if token.info else ""
            assert token.map is not None
            found.append(Block(page, token.map[0] + 1, language, token.content, before))
            before = ""
    return found


def run_python(block: Block, names: dict[str, Any]) -> None:
    """Run a block with the names of those before it; errors point to the page."""
    tree = ast.parse(block.text, str(block.page))
    ast.increment_lineno(tree, block.line)
    exec(compile(tree, str(block.page), "exec"), names)


def commands(block: Block) -> Iterator[list[str]]:
    """The words of each command of a shell block."""
    for line in block.text.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words:
            yield words


def expanded(words: list[str]) -> list[str]:
    """Words with the files that their patterns match in the current folder, as a shell has it."""
    return [name for word in words for name in sorted(glob(word)) or [word]]
