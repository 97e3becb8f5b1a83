"""The blocks of docs/packages.md, where the packages are installed."""

import re

import pytest
import torch
from helpers.snippets import ROOT, Block, blocks, run_python

PAGE = ROOT / "docs" / "packages.md"
BLOCKS = {match[1]: block for block in blocks(PAGE) if (match := re.search(r"needs `(\w+)`", block.before))}


@pytest.fixture(scope="module")
def names() -> dict[str, object]:
    """What the first block of the page defines."""
    found: dict[str, object] = {"__name__": "page"}
    run_python(blocks(PAGE)[0], found)
    return found


def test_all_packages_are_there() -> None:
    assert set(BLOCKS) == {"torch_geometric", "pytorch3d", "kaolin", "physicsnemo", "lightning"}


@pytest.mark.parametrize(("package", "block"), BLOCKS.items(), ids=list(BLOCKS))
def test_a_block_runs(package: str, block: Block, names: dict[str, object]) -> None:
    pytest.importorskip(package, reason=f"{package} is not installed", exc_type=ImportError)
    found = dict(names)
    run_python(block, found)
    if package == "lightning":
        assert found["trainer"].global_step == 2
    else:
        torch.testing.assert_close(found["back"], names["x"])
