"""What would be uploaded to PyPI: built here, and checked by the usual tools."""

import email
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def tool(*command: str, cwd: Path = ROOT) -> str:
    done = subprocess.run([sys.executable, "-m", *command], cwd=cwd, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the source distribution, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("dist")
    # Without isolation: the tools are those of this environment, and nothing is downloaded.
    tool("build", "--no-isolation", "--outdir", str(folder), str(ROOT))
    return folder


@pytest.fixture(scope="module")
def metadata(built: Path) -> email.message.Message:
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return email.message_from_bytes(archive.read(name))


def test_twine_and_check_wheel_contents_pass(built: Path) -> None:
    files = sorted(map(str, built.iterdir()))
    assert len(files) == 2
    assert tool("twine", "check", "--strict", *files).count("PASSED") == 2
    (wheel,) = built.glob("*.whl")
    assert "OK" in tool("check_wheel_contents", str(wheel))


def test_metadata_of_the_wheel(metadata: email.message.Message) -> None:
    assert metadata["Author"] == "torch_modal contributors"
    classifiers = metadata.get_all("Classifier") or []
    assert {f"Programming Language :: Python :: 3.{minor}" for minor in (10, 11, 12, 13, 14)} <= set(classifiers)
    urls = {url.split(",")[0] for url in metadata.get_all("Project-URL") or []}
    assert {"Changelog", "Documentation", "Issues"} <= urls
    needed = [line for line in metadata.get_all("Requires-Dist") or [] if "extra ==" not in line]
    assert not [line for line in needed if re.match(r"pyvista|vtk|imageio|usd|pygltflib|pytetwild\[", line)]


def test_links_of_the_page_on_pypi_are_whole_and_lead_somewhere(metadata: email.message.Message) -> None:
    text = metadata.get_payload()
    links = re.findall(r"\]\(([^)\s]+)\)", text)
    assert len(links) > 8 and all(link.startswith(("https://", "#")) for link in links)
    files = re.findall(r"\]\(https://github\.com/[^/]+/[^/]+/(raw|blob)/HEAD/([^)#\s]+)", text)
    assert {kind for kind, _ in files} == {"raw", "blob"}
    for kind, file in files:
        assert (ROOT / file).exists(), file
        assert (kind == "raw") == file.endswith((".png", ".gif"))


def test_wheel_holds_the_package_alone(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    assert wheel.name.endswith("-py3-none-any.whl"), "nothing is compiled"
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"torch_modal"}
    for wanted in ("py.typed", "__init__.pyi", "samples/hand/key-0.ply", "samples/creature/key-5.ply"):
        assert f"torch_modal/{wanted}" in names
    sources = {str(path.relative_to(ROOT)) for path in (ROOT / "torch_modal").rglob("*.py")}
    assert sources == {name for name in names if name.endswith(".py")}


def test_source_distribution_is_whole(built: Path) -> None:
    """Its tests can run: what they read is in it."""
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for folder in ("tests", "examples", "docs", "torch_modal"):
        sources = {str(path.relative_to(ROOT)) for path in (ROOT / folder).rglob("*") if path.is_file()}
        assert {name for name in sources if not name.endswith(".pyc")} <= names
    assert {"LICENSE", "README.md", "CHANGELOG.md", "CITATION.cff", "constraints.txt", "pyproject.toml"} <= names
    assert {".ci/run", "tests/run.sh", "setup.py"} <= names


def test_versions_agree() -> None:
    version = re.search(r'__version__ = "(.+)"', (ROOT / "torch_modal" / "version.py").read_text())
    assert version and f"version: {version[1]}\n" in (ROOT / "CITATION.cff").read_text()
