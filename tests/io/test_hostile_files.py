"""Crafted files: an error that names the file, or the mesh; in a second, 200 MB, and without files of other folders."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import torch_modal as tm

if sys.platform != "linux":
    pytest.skip("memory and opened files are measured on Linux", allow_module_level=True)

from helpers.hostile_files import CASES, RIGHT

TESTS = Path(__file__).parents[1]
SECONDS, MEGABYTES = 4.0, 200.0


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """All cases, by their names."""
    path = os.pathsep.join([str(Path(tm.__file__).parents[1]), str(TESTS)])
    run = subprocess.run(
        [sys.executable, "-m", "helpers.hostile_files", str(tmp_path_factory.mktemp("files"))],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert run.returncode == 0, run.stderr
    return {found["name"]: found for found in map(json.loads, run.stdout.splitlines())}


@pytest.mark.parametrize("name", CASES)
def test_a_crafted_file_is_an_error_or_its_mesh(name: str, measured: dict[str, dict[str, Any]]) -> None:
    found = measured[name]
    result = found["result"]
    assert result == "right" if name in RIGHT else result.startswith("error: "), found
    assert name == "mesh of a long name" or not result.startswith("error: FileNotFoundError"), result
    assert len(result.splitlines()) == 1 and len(result) < 700
    assert found["seconds"] < SECONDS and found["megabytes"] < MEGABYTES, found
    assert found["opened"] == [] and found["embedded"] == []
    if name.startswith("ply: ") and name not in RIGHT and name not in ("ply: corners", "ply: ends of headers"):
        assert "the header promises" in result
    # What is left out is said, by name.
    if any(what in name for what in ("texture, ", "image, ", "library, ")):
        assert len(set(found["warnings"])) == 1 and " is without " in found["warnings"][0]
