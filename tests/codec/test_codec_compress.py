"""Small files of motions: what is promised is kept, the same everywhere, and a damaged or hostile file is an error."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Shapes
from safetensors.torch import load_file, save_file
from torch import Tensor

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.codec import amplitudes, hierarchy, positions
from torch_modal.codec.faces import pack_integers, unpack_integers
from torch_modal.codec.header import read_header
from torch_modal.codec.hierarchy import VertexHierarchy
from torch_modal.codec.range_coder import IntegerDecoder, IntegerEncoder

pytest.importorskip("constriction")
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def motion(bars: Shapes) -> Tensor:
    """Twelve frames: the path through three poses, and a mode that swings beside it."""
    basis = bars.bases[0]
    decoder = tm.ModalDecoder(
        bars.keyframes, bars.faces, torch.tensor([0.0, 5.0, 11.0]).double(), basis.reference, basis.modes
    )
    t = torch.arange(12).double()
    a = torch.zeros(12, 8).double()
    a[:, 0], a[:, 2] = 2 * torch.sin(t), torch.sin(1.3 * t)
    return decoder(a, t)


@pytest.fixture(scope="module")
def written(motion: Tensor, bars: Shapes, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tm.Compressed]:
    path = tmp_path_factory.mktemp("tms") / "bar.tms"
    return path, tm.compress(motion, bars.faces, path, 0.003, 12, progress=False)


@pytest.mark.parametrize("error", [0.0005, 0.02])
def test_the_promised_error_is_kept(motion: Tensor, bars: Shapes, tmp_path: Path, error: float) -> None:
    found = tm.compress(motion, bars.faces, tmp_path / "a.tms", error, 12, progress=False)
    read = tm.ModalSequence.load(tmp_path / "a.tms")
    assert torch.equal(read.faces, bars.faces)
    size = (motion[0].amax(0) - motion[0].amin(0)).norm()
    measured = (read.decode() - motion).norm(dim=-1).mean(1) / size
    assert float(measured.max()) <= error and torch.allclose(measured, found.errors, rtol=0, atol=1e-12)
    assert found.n_bytes == (tmp_path / "a.tms").stat().st_size < motion.numel() * 4 / (4 if error < 0.001 else 10)


def test_times_and_cycles_come_back(bars: Shapes, tmp_path: Path) -> None:
    basis = bars.bases[0]
    decoder = tm.ModalDecoder(
        bars.keyframes, bars.faces, torch.tensor([0.0, 2.0, 4.0, 6.0]).double(), basis.reference, basis.modes
    )
    frames = decoder(torch.zeros(6, 8).double(), torch.arange(6).double())
    times = [0.0, 0.5, 1.0, 2.0, 2.5, 3.0, 4.0]
    tm.compress(frames, bars.faces, tmp_path / "a.tms", 0.01, 8, times=times, cyclic=True, progress=False)
    found = tm.ModalSequence.load(tmp_path / "a.tms")
    assert found.cyclic and found.times.tolist() == times[:-1] and float(found.keyframe_times[-1]) == 4.0


CODE = """
import sys, torch
import torch_modal as tm
torch.set_num_threads(int(sys.argv[1]))
motion, faces = torch.load(sys.argv[2])
tm.compress(motion, faces, sys.argv[3], 0.003, 12, progress=False, cache=False)
torch.save(tm.ModalSequence.load(sys.argv[3], cache=False).decode(), sys.argv[4])
"""


def test_another_process_with_other_threads_writes_and_reads_the_same(
    motion: Tensor, bars: Shapes, written: tuple[Path, tm.Compressed], tmp_path: Path
) -> None:
    torch.save((motion, bars.faces), tmp_path / "in.pt")
    out = tmp_path / "a.tms"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "3", "OPENBLAS_NUM_THREADS": "3"}
    arguments = ["3", str(tmp_path / "in.pt"), str(out), str(tmp_path / "out.pt")]
    subprocess.run([sys.executable, "-c", CODE, *arguments], check=True, env=environment, timeout=300)
    assert out.read_bytes() == written[0].read_bytes()
    x = torch.load(tmp_path / "out.pt")
    assert float((x - tm.ModalSequence.load(written[0]).decode()).abs().max()) < 1e-9
    size = (motion[0].amax(0) - motion[0].amin(0)).norm()
    assert float((x - motion).norm(dim=-1).mean(1).max() / size) <= 0.003


# ------------------------------------------------------------------------------------------------------------- packing
@pytest.mark.parametrize("guided", [False, True])
def test_rounded_levels_are_read_as_they_were_written(bars: Shapes, guided: bool) -> None:
    x, guide = (y.numpy() / float(y.norm(dim=1).max()) for y in (bars.keyframes[1], bars.keyframes[0]))
    levels = VertexHierarchy(bars.faces.numpy(), len(x))
    assert len(levels.levels) > 2
    assert sorted(np.concatenate([level.vertices for level in levels.levels])) == list(range(len(x)))
    for step in (0.003, 0.03):
        numbers, found = levels.encode(x, step, guide if guided else None)
        assert np.array_equal(
            VertexHierarchy(bars.faces.numpy(), len(x)).decode(numbers, step, guide if guided else None), found
        )
        assert np.abs(found - x).max() < (0.5 + 0.17 + 1e-9) * step


def test_a_smooth_shape_takes_few_numbers_and_one_that_bends_little_more(bars: Shapes) -> None:
    """Most numbers of a rounded bar are zero; those of a bent one, whose guide is the straight one, too."""
    x = bars.keyframes.numpy() / float(bars.keyframes.norm(dim=2).max())
    levels = VertexHierarchy(bars.faces.numpy(), x.shape[1])

    def some(shape: np.ndarray, guide: np.ndarray | None) -> int:
        return sum(int(np.count_nonzero(each)) for each in levels.encode(shape, 0.02, guide)[0])

    free, guided = some(x[1], None), some(x[1], x[0])
    assert guided < 0.7 * free < 0.7 * x[1].size


@pytest.mark.parametrize(
    "faces",
    [
        [[0, 1, 2], [3, 4, 5]],  # two pieces
        [[0, 1, 2], [0, 1, 3], [0, 1, 4]],  # three at one edge
        [[2, 1, 0]],  # and vertices of no face
    ],
)
def test_levels_of_any_connectivity(faces: list[list[int]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hierarchy, "COARSEST", 2)
    x = np.random.default_rng(0).normal(size=(7, 3))
    levels = VertexHierarchy(np.array(faces), 7)
    assert sorted(np.concatenate([level.vertices for level in levels.levels])) == list(range(7))
    for guide in (None, x[::-1].copy()):
        numbers, found = levels.encode(x, 0.1, guide)
        assert np.abs(found - x).max() < 0.068 and np.array_equal(levels.decode(numbers, 0.1, guide), found)


def test_finished_shapes_forgive_other_rounding(bars: Shapes) -> None:
    """Another machine's sums differ in the last digits; the finished key-frames do not."""
    x = bars.keyframes.numpy() / float(bars.keyframes.norm(dim=2).max())
    rounded = positions.QuantizedKeyframes(VertexHierarchy(bars.faces.numpy(), x.shape[1]), x, 0.01)
    noise = 1e-12 * np.random.default_rng(0).normal(size=x[0].shape)
    levels, guide = VertexHierarchy(bars.faces.numpy(), x.shape[1]), None
    for i, numbers in enumerate(rounded.numbers):
        guide = rounded.decoded[rounded.guides[i]] if i else None
        found = levels.decode(numbers, 0.01, guide)
        shape = positions.on_grid(found + noise, 0.01, rounded.shifts[i])
        assert np.array_equal(shape, rounded.decoded[i])
        assert np.abs(shape - found).max() <= 0.01 / positions.FINER


@pytest.mark.parametrize("cyclic", [False, True])
def test_series_are_sums_of_sines(cyclic: bool) -> None:
    keys = [0, 1, 7, 19]
    between = amplitudes.runs(keys, 24 if cyclic else 20, cyclic)
    assert [(run.start, run.stop) for run in between] == [(2, 7), (8, 19)] + cyclic * [(20, 24)]
    series = np.random.default_rng(0).normal(size=(24 if cyclic else 20, 9))
    series[keys] = 0
    steps = amplitudes.column_steps(3, 0.1, 0.01, 0.02)
    found = amplitudes.from_sines(amplitudes.to_sines(series, steps, between), steps, between)
    apart = np.sqrt(np.square(found - series).sum(0) / len(series))
    assert bool((apart < 0.4 * steps).all()) and bool((apart > 0.1 * steps).all())
    slow = np.zeros_like(series)
    slow[8:19] = np.sin(np.pi * np.arange(1, 12) / 12)[:, None]
    assert np.count_nonzero(amplitudes.to_sines(slow, steps, between)) == 9


def test_the_range_coder_is_near_the_entropy() -> None:
    rng = np.random.default_rng(0)
    rare = np.rint(rng.laplace(0, 0.3, 6000)).astype(np.int64)
    wide = np.rint(rng.normal(0, 3000, 500)).astype(np.int64)
    few = np.array([0, -5, 2**39, 2**21, -(2**39)])
    numbers = np.concatenate([rare, wide, few])
    kinds = np.repeat([0, 1, 3], [len(rare), len(wide), len(few)])
    writer = IntegerEncoder()
    writer.write(numbers, kinds, 5)
    data = writer.data()
    assert np.array_equal(IntegerDecoder(data).read(kinds, 5), numbers)
    part = np.bincount(rare - rare.min()) / len(rare)
    bits = -float((part[part > 0] * np.log2(part[part > 0])).sum()) * len(rare) + len(wide) * np.log2(
        3000 * np.sqrt(2 * np.pi * np.e)
    )
    assert 8 * len(data) < 1.03 * bits + 400
    with pytest.raises(ValueError, match="damaged"):
        IntegerDecoder(data).read(kinds[:-5], 5)
    with pytest.raises(ValueError, match="too large"):
        IntegerEncoder().write(np.array([2**41]), np.array([0]), 1)


@pytest.mark.parametrize("numbers", [[], [0], [-1, 1, 0], [2**40, -(2**40), 3], list(range(-200, 200))])
def test_numbers_are_packed_and_unpacked(numbers: list[int]) -> None:
    array = np.array(numbers, dtype=np.int64)
    assert unpack_integers(pack_integers(array), len(array)).tolist() == numbers
    with pytest.raises(ValueError, match="damaged"):
        unpack_integers(pack_integers(array), len(array) + 1)


# -------------------------------------------------------------------------------------------------- damaged and hostile
def rewritten(path: Path, out: Path, **changes: object) -> Path:
    """The file with other entries in its header, or in the head of its numbers."""
    tensors = load_file(path)
    data = path.read_bytes()
    header = json.loads(json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]["torch_modal"])
    outer = {name: changes.pop(name) for name in list(changes) if name in header}
    packed = tensors["packed"].numpy().tobytes()
    head, end = read_header(packed)
    changed = head._replace(**changes).data() + packed[end:]
    tensors["packed"] = torch.frombuffer(bytearray(changed), dtype=torch.uint8)
    save_file(tensors, out, {"torch_modal": json.dumps({**header, **outer})})
    return out


def test_a_cut_file_is_an_error(written: tuple[Path, tm.Compressed], tmp_path: Path) -> None:
    data = written[0].read_bytes()
    for n in (0, 4, 100, len(data) // 2, len(data) - 1):
        (tmp_path / "cut.tms").write_bytes(data[:n])
        with pytest.raises(ValueError, match=r"cut\.tms"):
            tm.ModalSequence.load(tmp_path / "cut.tms")


def test_any_changed_byte_is_an_error_or_changes_nothing(
    written: tuple[Path, tm.Compressed], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torch_modal.codec import file

    data = written[0].read_bytes()
    before = tm.ModalSequence.load(written[0])
    # Modes follow from what the digest covers.
    monkeypatch.setattr(file, "reproducible_modes", lambda *_: before.modes)
    start = 8 + int.from_bytes(data[:8], "little")
    for place in np.random.default_rng(0).integers(start, len(data), 60).tolist():
        changed = bytearray(data)
        changed[place] ^= 0x55
        (tmp_path / "a.tms").write_bytes(changed)
        try:
            found = tm.ModalSequence.load(tmp_path / "a.tms")
        except ValueError:
            continue
        assert torch.equal(found.amplitudes, before.amplitudes) and torch.equal(found.keyframes, before.keyframes)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"version": "1"}, "version"),
        ({"format": "other"}, "holds no motion"),
        ({"coding": "pickle"}, "coding"),
        ({"n_vertices": 2**31}, "vertices that it does not have|claims"),
        ({"n_vertices": 10**6}, "vertices that it does not have|claims|damaged"),
        ({"n_vertices": 10**18}, "header"),
        ({"n_vertices": 0}, "header"),
        ({"n_frames": 2**30}, "key-frames"),
        ({"n_frames": 2**30, "cyclic": 1}, "claims to hold"),
        ({"n_faces": 10**8}, "claims to hold"),
        ({"n_faces": 10**9}, "damaged"),
        ({"n_modes": 10**8}, "claims to hold"),
        ({"n_clusters": 10**8}, "header"),
        ({"n_probes": 10**8}, "header"),
        ({"n_face_bytes": 10**8}, "damaged"),
        ({"n_face_bytes": 0}, "damaged"),
        ({"keys": [0, 99]}, "key-frames|header"),
        ({"keys": [0, 11, 11]}, "header|key-frames|damaged"),
        ({"guides": [-1, 9]}, "no known way|header|damaged"),
        ({"shifts": [99, 0]}, "header|damaged"),
        ({"seed": 15}, "damaged"),
        ({"floats": [0.0, 0.0, 0.0, 1e-3, 0.0, 1.0, 1.0, 1.0]}, "header"),
        ({"floats": [float("nan")] * 8}, "header"),
        ({"digest": b"12345678"}, "damaged"),
        ({"reference": 77}, "damaged"),
    ],
)
def test_a_header_is_not_believed(
    written: tuple[Path, tm.Compressed], tmp_path: Path, changes: dict[str, object], match: str
) -> None:
    with pytest.raises(ValueError, match=match):
        tm.ModalSequence.load(rewritten(written[0], tmp_path / "a.tms", **changes))


def test_other_files_are_refused(tmp_path: Path, bars: Shapes) -> None:
    bars.bases[0].save(tmp_path / "basis.tms")
    with pytest.raises(ValueError, match="holds no motion"):
        tm.ModalSequence.load(tmp_path / "basis.tms")
    (tmp_path / "text.tms").write_text("o bar\nv 0 0 0\n")
    with pytest.raises(ValueError, match=r"text\.tms is no \.tms file"):
        tm.ModalSequence.load(tmp_path / "text.tms")
    with pytest.raises(FileNotFoundError):
        tm.ModalSequence.load(tmp_path / "missing.tms")


def test_other_modes_are_noticed(written: tuple[Path, tm.Compressed], monkeypatch: pytest.MonkeyPatch) -> None:
    from torch_modal.codec import file

    real = file.reproducible_modes

    def other(*arguments: object) -> object:
        found = real(*arguments)  # type: ignore[arg-type]
        return found._replace(modes=found.modes.flip(0))

    monkeypatch.setattr(file, "reproducible_modes", other)
    with pytest.raises(ValueError, match="modes computed here differ"):
        tm.ModalSequence.load(written[0])


# ------------------------------------------------------------------------------------------------------------ commands
def test_commands(motion: Tensor, bars: Shapes, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    meshes = [str(file) for file in tm.save_frames(motion, bars.faces, tmp_path / "in", "obj")]
    out = tmp_path / "bar.tms"
    assert cli.main(["compress", *meshes, "--error", "0.5%", "--modes", "8", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "12 frames of 164 vertices" in said and "allowed: 0.5 %" in said
    assert cli.main(["compress", *meshes, "--out", str(out)]) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert cli.main(["expand", str(out), "--out", str(tmp_path / "back"), "--format", "obj", "--quiet"]) == 0
    frames, faces = tm.load_keyframes(sorted((tmp_path / "back").glob("*.obj")))
    assert torch.equal(faces, bars.faces)
    size = (motion[0].amax(0) - motion[0].amin(0)).norm()
    assert float((frames - motion).norm(dim=-1).mean(1).max() / size) <= 0.005
    assert cli.main(["expand", str(out), "--frames", "30", "--out", str(tmp_path / "slow.npz"), "--quiet"]) == 0
    assert (tmp_path / "slow.npz").exists()
    (tmp_path / "bad.tms").write_bytes(out.read_bytes()[:500])
    assert cli.main(["expand", str(tmp_path / "bad.tms"), "--out", str(tmp_path / "no")]) == 1
    assert not (tmp_path / "no").exists()
    for wrong in (["compress", meshes[0], "--out", str(out)], ["compress", *meshes, "--error", "2", "--out", "a.tms"]):
        with pytest.raises(SystemExit):
            cli.main(wrong)


def test_what_is_missing_is_said(
    motion: Tensor,
    bars: Shapes,
    written: tuple[Path, tm.Compressed],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from torch_modal import extras

    real = extras.importlib.util.find_spec
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda name: None if name == "constriction" else real(name))
    monkeypatch.setitem(sys.modules, "constriction", None)
    for work in (
        lambda: tm.compress(motion, bars.faces, tmp_path / "a.tms"),
        lambda: tm.ModalSequence.load(written[0]),
    ):
        with pytest.raises(ImportError, match=r"needs constriction.*torch_modal\[compress\]"):
            work()
