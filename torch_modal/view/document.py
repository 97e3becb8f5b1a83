"""A page as one HTML file that needs no other files and no network.

Joins the files in page_assets with the data of a page. Its content security policy allows its own scripts by their
hashes and forbids all else, so that text in file names or titles cannot run.
"""

import base64
import hashlib
import html
import json
import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from torch_modal.io.files import write_file
from torch_modal.io.formats import PAGES
from torch_modal.io.write import check_suffix, refuse_existing
from torch_modal.version import __version__

POLICY = "default-src 'none'; img-src data: blob:; base-uri 'none'; form-action 'none'"


class Page:
    """A page of shapes, which notebooks display and :meth:`save` writes.

    Attributes:
        html: The whole page.
        height: In pixels, in a notebook.

    Raises:
        ValueError: A height below 1.
    """

    def __init__(self, html: str, height: int = 600) -> None:
        if height < 1:
            raise ValueError(f"height is a number of pixels, at least 1; got {height}.")
        self.html = html
        self.height = height

    def __repr__(self) -> str:
        return f"<torch_modal.Page of {len(self.html) / 1e6:.1f} MB; its save(path) writes it>"

    def _repr_html_(self) -> str:
        # The sandbox isolates the page's scripts from the notebook's.
        return (
            '<iframe sandbox="allow-scripts allow-downloads" allow="clipboard-write" loading="lazy" '
            f'style="width: 100%; height: {self.height}px; border: 1px solid #dde3e9; border-radius: 8px" '
            f'srcdoc="{html.escape(self.html)}"></iframe>'
        )

    def save(self, out: str | Path, overwrite: bool = False) -> Path:
        """Write the page as one HTML file.

        Args:
            out: File to write, ``*.html``.
            overwrite: Replace the file if it exists.

        Returns:
            The file.

        Raises:
            ValueError: ``out`` does not end in .html.
            FileExistsError: The file exists and ``overwrite`` is off.
        """
        path = checked_path(out, overwrite)
        write_file(path, self.html.encode("utf-8"))
        return path


def checked_path(out: str | Path, overwrite: bool) -> Path:
    """The path of a page that may be written; raises as `Page.save` does."""
    path = Path(out)
    check_suffix(path, PAGES)
    refuse_existing(path, overwrite)
    return path


def document(template: str, scripts: Sequence[str], title: str, data: dict[str, Any]) -> str:
    """The text of a page. Titles and names are escaped; scripts and style are allowed by their hashes.

    Args:
        template: Its file in page_assets.
        scripts: Its scripts besides three.js, in order.
        title: Of the page.
        data: The data of the scripts.
    """
    assets = files("torch_modal.view") / "page_assets"

    def asset(*names: str) -> str:
        return "\n".join((assets / name).read_text(encoding="utf-8") for name in names)

    style, library = asset("page.css"), asset("three.min.js")
    # In a function scope, strict.
    program = f'(() => {{\n"use strict";\n{asset(*scripts)}}})();\n'
    policy = f"{POLICY}; style-src {_hash(style)}; script-src {_hash(library)} {_hash(program)}"
    parts = {
        "@POLICY@": policy,
        "@GENERATOR@": f"torch_modal {__version__}",
        "@TITLE@": html.escape(title),
        "@STYLE@": style,
        "@DATA@": json.dumps(data, allow_nan=False).replace("<", "\\u003c"),
        "@LIBRARY@": library,
        "@PROGRAM@": program,
    }
    # In one pass: markers inside inserted text stay.
    return re.sub("|".join(parts), lambda marker: parts[marker.group()], asset(template))


def _hash(text: str) -> str:
    """The source expression of an inline script or style in a content security policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode('utf-8')).digest()).decode('ascii')}'"
