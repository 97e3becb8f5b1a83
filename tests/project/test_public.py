"""The benchmark for others: layouts of public data, and results that come from elsewhere."""

from pathlib import Path
from unittest import mock

import numpy as np
import public
import pytest
import torch
from conftest import Shapes


@pytest.fixture
def registrations(bars: Shapes, tmp_path: Path) -> Path:
    """A file as DFAUST has it, of two sequences of nine frames."""
    h5py = pytest.importorskip("h5py")
    frames = torch.stack([torch.lerp(*bars.keyframes[:2], t) for t in torch.linspace(0, 1, 9, dtype=torch.float64)])
    file = tmp_path / "registrations_f.hdf5"
    with h5py.File(file, "w") as stored:
        stored["faces"] = bars.faces.numpy().astype(np.uint32)
        for name in ("50004_hips", "50004_knees"):
            stored[name] = frames.movedim(0, -1).numpy().astype(np.float32)
    return file


def test_sequences_of_dfaust(bars: Shapes, registrations: Path) -> None:
    both = list(public.clips([], [registrations], step=4))
    assert [clip.name for clip in both] == ["50004_hips", "50004_knees"]
    (one,) = public.clips([], [Path(f"{registrations}:50004_knees")], step=4)
    assert one.faces.equal(bars.faces) and one.given.tolist() == [0, 4, 8]
    torch.testing.assert_close(one.frames[0], bars.keyframes[0], rtol=0, atol=1e-6)
    assert public.Measures(one).of(public.answer(one, public.linear)[0])["edges, %"] < 1e-3
    with pytest.raises(SystemExit, match="it has 50004_hips, 50004_knees"):
        list(public.clips([], [Path(f"{registrations}:50004_arms")], step=4))


@mock.patch("public.limit_threads")
def test_results_of_others(
    limit_threads: mock.Mock, registrations: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is exported is enough to answer, and answers have the score of the same method."""
    common = ["public.py", "--bodies", "--sequences", f"{registrations}:50004_hips", "--step", "8"]
    with mock.patch("sys.argv", [*common, "--export", str(tmp_path / "clips")]):
        public.main()
    (file,) = (tmp_path / "clips").iterdir()
    given = {name: torch.from_numpy(value) for name, value in np.load(file).items()}
    (tmp_path / "mine").mkdir()
    shapes = public.linear(given["keyframes"], given["faces"], given["times"].double(), given["wanted"].double())
    np.save(tmp_path / "mine" / f"{file.stem}.npy", shapes.numpy())
    with mock.patch("sys.argv", [*common, "--methods", "linear", "--results", str(tmp_path / "mine")]):
        public.main()
    rows = {
        line.split("|")[1].strip(): line.split("|")[2:-2]
        for line in capsys.readouterr().out.splitlines()
        if "|" in line
    }
    assert rows["linear"] == rows["mine"]
