"""What long work says, and how errors of writing name files."""

import errno
import logging
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from solids import box, surface

import torch_modal as tm
from torch_modal import progress as module
from torch_modal.cli import main as cli
from torch_modal.io.files import temporary_beside, write_atomically
from torch_modal.progress import ProgressReport


@pytest.fixture
def bar() -> tuple[np.ndarray, np.ndarray]:
    solid = box((4, 2, 2), (4.0, 1.0, 1.0))
    used, faces = np.unique(surface(solid), return_inverse=True)
    return solid.vertices[used], faces.reshape(-1, 3)


# ------------------------------------------------------------------------------------------------------------ progress
def test_lines_of_the_log_every_few_seconds(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    clock = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    with caplog.at_level(logging.INFO, "torch_modal"), ProgressReport(100, "modes") as report:
        for step in range(100):
            clock[0] = step * 0.2
            report.update()
        report.describe("the last")
    assert [record.message for record in caplog.records] == [
        "modes (26 of 100)",
        "modes (51 of 100)",
        "modes (76 of 100)",
    ]
    assert {record.name for record in caplog.records} == {"torch_modal"}


def test_a_callback_is_told_each_step_and_may_end_the_work() -> None:
    said: list[tuple[int, int, str]] = []
    with ProgressReport(3, "a", lambda *now: said.append(now)) as report:
        report.update()
        report.describe("b")
        report.update(2)
    assert said == [(1, 3, "a"), (1, 3, "b"), (3, 3, "b")]

    def stop(done: int, total: int, what: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), ProgressReport(3, "a", stop) as report:
        report.update()


def test_false_is_silent_and_true_is_a_bar(
    capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.DEBUG), ProgressReport(2, "quiet", False) as report:
        report.update(2)
    assert capsys.readouterr().err == "" and not caplog.records
    with ProgressReport(2, "shown", True) as report:
        report.update()
    assert "shown" in capsys.readouterr().err


def test_terminal_gets_a_bar(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with ProgressReport(2, "on a terminal") as report:
        report.update()
    assert "on a terminal" in capsys.readouterr().err


def test_modes_take_a_callback(bar: tuple[np.ndarray, np.ndarray]) -> None:
    said: list[tuple[int, int, str]] = []
    x, faces = bar
    tm.extract_bases(
        np.stack([x, 1.1 * x]), faces, 4, mesher="lattice", cache=False, progress=lambda *now: said.append(now)
    )
    assert said[-1][:2] == (4, 4) and [done for done, _, _ in said] == sorted(done for done, _, _ in said)
    assert any("key-frame 2/2" in what for _, _, what in said)


@pytest.mark.parametrize(("option", "lines"), [((), True), (("--quiet",), False), (("--verbose",), True)])
def test_command_says_lines_without_a_terminal(
    tmp_path: Path,
    bar: tuple[np.ndarray, np.ndarray],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    option: tuple[str, ...],
    lines: bool,
) -> None:
    monkeypatch.setattr(module, "SECONDS_BETWEEN_LINES", 0.0)
    x, faces = bar
    files = tm.save_frames(np.stack([x, 1.1 * x]), faces, tmp_path / "in", "obj")
    argv = [
        "modes",
        *map(str, files),
        "--modes",
        "4",
        "--mesher",
        "lattice",
        "--no-cache",
        "--out",
        str(tmp_path / "b"),
    ]
    assert cli.main([*argv, *option]) == 0
    said = capsys.readouterr().err
    assert bool(re.search(r"^torch-modal: key-frame \d/2: .+ \(\d of 4\)$", said, re.M)) == lines
    assert logging.getLogger("torch_modal").handlers == []  # nothing is left behind


def test_verbose_says_what_is_written(
    tmp_path: Path, bar: tuple[np.ndarray, np.ndarray], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.DEBUG, "torch_modal"):
        (path,) = tm.save_frames(bar[0][None], bar[1], tmp_path, "obj")
    assert [record.message for record in caplog.records] == [f"wrote {path}, {path.stat().st_size / 1000:.1f} kB"]


# ------------------------------------------------------------------------------------------------------ errors of files
def test_write_errors_name_the_users_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = tmp_path / "missing" / "a.glb"
    with pytest.raises(FileNotFoundError) as caught:
        write_atomically(wanted, b"x")
    assert caught.value.filename == str(wanted) and ".tmp" not in str(caught.value)

    def full(self: Path, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device", str(self))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"No space left on device: '[^']*/b\.glb'") as caught_again:
        write_atomically(tmp_path / "b.glb", b"x")
    assert caught_again.value.errno == errno.ENOSPC and list(tmp_path.iterdir()) == []
    with pytest.raises(PermissionError) as other, temporary_beside(tmp_path / "c.glb"):
        raise PermissionError(errno.EACCES, "of another file", "/elsewhere")
    assert other.value.filename == "/elsewhere"


def test_the_command_names_the_path_in_one_line(
    tmp_path: Path,
    bar: tuple[np.ndarray, np.ndarray],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    x, faces = bar
    files = tm.save_frames(np.stack([x, 1.1 * x]), faces, tmp_path / "in", "obj")
    monkeypatch.setattr(tm, "subdivide", lambda keyframes, *_, **__: keyframes)
    replace = os.replace

    def refused(source: object, target: object) -> None:
        if str(target).endswith("a.glb"):
            raise PermissionError(errno.EACCES, "Permission denied", str(source), None, str(target))
        replace(source, target)  # type: ignore[arg-type]

    monkeypatch.setattr(os, "replace", refused)
    out = tmp_path / "a.glb"
    argv = ["subdivide", *map(str, files), "--levels", "0", "--modes", "4", "--mesher", "lattice", "--out", str(out)]
    assert cli.main([*argv, "--quiet"]) == 1
    assert capsys.readouterr().err == f"torch-modal: error: {out}: Permission denied\n"
    assert not out.exists()
