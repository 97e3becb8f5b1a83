"""What long work says, and how errors of writing name files."""

import errno
import logging
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.io.files import atomic_write
from torch_modal.io.formats import ANIMATION_FORMATS, Animation, OutputFormat
from torch_modal.progress import ProgressReport


# ------------------------------------------------------------------------------------------------------------ progress
@pytest.mark.parametrize(("terminal", "progress", "shown"), [(0, None, 0), (1, None, 1), (1, False, 0), (0, True, 1)])
def test_a_bar_is_shown_on_terminals(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    terminal: int,
    progress: bool | None,
    shown: int,
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: bool(terminal), raising=False)
    with ProgressReport(0, "first", progress) as report:
        report.expect(2)
        report.update()
        report.set_description("second")
    said = capsys.readouterr().err
    assert ("second" in said and "1/2" in said) if shown else said == ""


# ------------------------------------------------------------------------------------------------------ errors of files
def test_write_errors_name_the_users_path(tmp_path: Path) -> None:
    wanted = tmp_path / "missing" / "a.glb"
    with pytest.raises(FileNotFoundError) as caught, atomic_write(wanted):
        pass
    assert caught.value.filename == str(wanted) and ".tmp" not in str(caught.value)
    with pytest.raises(PermissionError) as other, atomic_write(tmp_path / "c.glb"):
        raise PermissionError(errno.EACCES, "of another file", "/elsewhere")
    assert other.value.filename == "/elsewhere"


@pytest.fixture
def unready() -> Iterator[None]:
    """A handler of SIGTERM that fails, instead of the default that ends the tests."""

    def fail(number: int, frame: object) -> None:
        raise AssertionError("the command does not listen to SIGTERM")

    before = signal.signal(signal.SIGTERM, fail)
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.mark.skipif(os.name != "posix", reason="other systems send no SIGTERM")
@pytest.mark.usefixtures("unready")
def test_sigterm_leaves_no_temporary_files(
    tmp_path: Path,
    capsule: tuple[np.ndarray, np.ndarray],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    files = tm.save_mesh(np.stack([capsule[0], 1.1 * capsule[0]]), capsule[1], tmp_path / "in", "obj")
    monkeypatch.setattr(tm, "interpolate", lambda keyframes, *_, **__: keyframes)
    there = []

    def write(animation: Animation, path: Path) -> None:
        path.write_bytes(b"a part")
        there.extend(path.parent.iterdir())
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setitem(ANIMATION_FORMATS, ".npz", OutputFormat(write))
    out = tmp_path / "out" / "a.npz"
    assert cli.main(["subdivide", *map(str, files), "--levels", "0", "--out", str(out), "--quiet"]) == 130
    assert capsys.readouterr().err == "torch-modal: interrupted\n"
    assert len(there) == 1 and list(out.parent.iterdir()) == []


@pytest.mark.parametrize("where", ["in", "out"])
def test_loops_of_links_and_long_names_are_one_line(
    where: str, tmp_path: Path, capsule: tuple[np.ndarray, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "loop.obj").symlink_to("loop.obj")
    (mesh,) = tm.save_mesh(capsule[0][None], capsule[1], tmp_path / "in", "obj")
    for path in (tmp_path / "loop.obj", tmp_path / f"{'n' * 5000}.obj"):
        inputs, out = (
            ([mesh, path], tmp_path / "a.glb") if where == "in" else ([mesh, mesh], path.with_suffix(".obj") / "a")
        )
        assert cli.main(["subdivide", *map(str, inputs), "--out", str(out), "--quiet"]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"torch-modal: error: {str(path)[:200]}") and len(line) < 600


def test_a_quiet_command_leaves_the_level_of_the_log(tmp_path: Path) -> None:
    logger = logging.getLogger("torch_modal")
    level = logger.level
    assert cli.main(["check", str(tmp_path / "missing.obj"), "--quiet"]) == 1
    assert logger.level == level


def test_advice_on_a_flat_surface_is_no_python(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.4, 0.6, 0]])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    tm.save_mesh(points, faces, tmp_path / "flat.obj")
    argv = ["modes", str(tmp_path / "flat.obj"), "--modes", "2", "--out", str(tmp_path / "a.safetensors"), "--no-cache"]
    assert cli.main([*argv, "--method", "solid", "--quiet"]) == 1
    said = capsys.readouterr().err
    assert "the surface is flat" in said and "(method shell)" in said and "=" not in said
