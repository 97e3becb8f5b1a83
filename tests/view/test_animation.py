"""Animations of all formats, read back by other libraries or by the letter of the format."""

import struct
import sys

import numpy as np
import pygltflib
import pytest
from helpers.textured import bend, textured_obj, triangles_of_tube
from PIL import Image

import torch_modal as tm
from torch_modal.errors import MeshWarning, MissingPackageError
from torch_modal.geometry.vectors import vertex_normals
from torch_modal.io.formats import ANIMATION_FORMATS, Timing

X, FACES = triangles_of_tube()
FRAMES = np.stack([bend(X, turn) for turn in (0.01, 0.3, 0.6, 0.9)])


# ------------------------------------------------------------------------------------------------------------ timing


def test_knots_and_samples_agree():
    """Both are the same motion: linear between knots, seen at a fixed rate."""
    for options in ({}, {"cyclic": True}, {"ping_pong": True}):
        timing = Timing(9, duration=2, fps=16, **options)
        times, places = timing.knots()
        assert times[0] == 0 and (np.diff(times) > 0).all()
        assert times[-1] == (4 if "ping_pong" in options else 2)
        unrolled = np.where((np.arange(len(places)) == len(places) - 1) & ("cyclic" in options), 9, places)
        samples = timing.samples()
        np.testing.assert_allclose(samples, np.interp(np.arange(len(samples)) / 16, times, unrolled), atol=1e-12)
        # A video that starts again does not show its first picture twice.
        assert len(samples) == {"ping_pong": 64, "cyclic": 32}.get(next(iter(options), ""), 33)
    assert Timing(1, ping_pong=True).samples().tolist() == [0]


def test_ease_is_slow_at_both_ends():
    timing = Timing(9, duration=2, fps=100, ease=True)
    speed = np.diff(timing.samples())
    assert speed[0] < 0.1 * speed[100] and speed[-1] < 0.1 * speed[100]
    times, places = timing.knots()
    np.testing.assert_allclose(8 * (1 - np.cos(np.pi * times / 2)) / 2, places, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"duration": 0}, "duration must be a positive"),
        ({"fps": float("nan")}, "fps must be a positive"),
        ({"cyclic": True, "ping_pong": True}, "ping_pong and ease are for sequences that begin"),
        ({"cyclic": True, "ease": True}, "ping_pong and ease are for"),
    ],
)
def test_timing_that_cannot_be(options, match):
    with pytest.raises(ValueError, match=match):
        Timing(9, **options)


# ----------------------------------------------------------------------------------------------------------- formats
@pytest.mark.parametrize(
    ("options", "end"),
    [
        ({}, 2),
        ({"keyframe_indices": [0, 1, 3]}, 2),
        ({"keyframe_indices": [0, 1, 2, 3]}, 3),
        ({"keyframe_indices": [0, 1, 2, 3], "cyclic": True}, 1),
        ({"ping_pong": True, "duration": 1.5}, 3),
        ({"fps": 6}, 0.5),
        ({"fps": 8, "cyclic": True}, 0.5),
        ({"fps": 10, "duration": 3}, 3),
    ],
)
def test_two_keyframes_make_two_seconds(tmp_path, options, end):
    gltf = pygltflib.GLTF2().load(tm.save_animation(FRAMES, FACES, tmp_path / "a.glb", **options))
    assert gltf.accessors[gltf.animations[0].samplers[0].input].max[0] == end


def test_an_animation_is_written_as_npz(tmp_path):
    path = tm.save_animation(FRAMES, FACES, tmp_path / "a.npz", keyframe_indices=[0, 3], duration=6)
    with np.load(path) as stored:
        np.testing.assert_array_equal(stored["frames"], FRAMES)
        np.testing.assert_array_equal(stored["faces"], FACES)
        assert stored["times"].tolist() == [0, 2, 4, 6] and stored["keyframes"].tolist() == [0, 3]


def test_mdd_by_the_letter(tmp_path):
    data = tm.save_animation(FRAMES, FACES, tmp_path / "a.mdd", duration=3, fps=2).read_bytes()
    n, v = struct.unpack_from(">2i", data)
    assert (n, v) == (7, len(X)) and len(data) == 8 + 4 * n + 12 * n * v
    np.testing.assert_array_equal(np.frombuffer(data, ">f4", n, 8), np.arange(7) / 2)
    points = np.frombuffer(data, ">f4", n * v * 3, 8 + 4 * n).reshape(n, v, 3)
    np.testing.assert_array_equal(points[::2], FRAMES.astype("f4"))
    np.testing.assert_allclose(points[1], (FRAMES[0] + FRAMES[1]) / 2, atol=1e-6)


def test_pc2_by_the_letter(tmp_path):
    data = tm.save_animation(FRAMES, FACES, tmp_path / "a.pc2", duration=3, fps=1).read_bytes()
    mark, version, v, start, rate, n = struct.unpack_from("<12siiffi", data)
    assert (mark, version, v, start, rate, n) == (b"POINTCACHE2\0", 1, len(X), 0.0, 1.0, 4)
    np.testing.assert_array_equal(np.frombuffer(data, "<f4", offset=32).reshape(n, v, 3), FRAMES.astype("f4"))


@pytest.mark.parametrize("suffix", ["usda", "usdc", "usd"])
def test_usd_read_back(tmp_path, suffix):
    usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed")
    from pxr import UsdGeom, UsdShade

    asset = tm.open_asset(textured_obj(tmp_path, "bar.obj"))
    frames = np.stack([bend(asset.positions, turn) for turn in (0.01, 0.5, 0.9)])
    others = [tmp_path / f"a-{i}.png" for i in range(3)]
    for other in others:
        other.write_bytes(b"of another file")
    with pytest.warns(MeshWarning, match="without the groups"):
        path = tm.save_animation(frames, asset.faces, tmp_path / f"a.{suffix}", duration=3, fps=24, asset=asset)
    stage = usd.Stage.Open(str(path))
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (24, 72)
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("mesh"))
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
    assert list(mesh.GetFaceVertexCountsAttr().Get()) == [4] * 84 + [3] * 24
    for time, frame in ((0, frames[0]), (36, frames[1]), (72, frames[2]), (18, (frames[0] + frames[1]) / 2)):
        np.testing.assert_allclose(mesh.GetPointsAttr().Get(time), frame, atol=1e-6)
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    assert st.GetInterpolation() == "faceVarying" and len(st.Get()) == 84 * 4 + 24 * 3
    assert np.allclose(next(iter(mesh.GetDisplayColorPrimvar().Get())), [0.2140, 0.0509, 1.0], atol=1e-3)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0  # as in glTF: of the same size in Blender
    normals = np.array(mesh.GetNormalsAttr().Get(36))
    np.testing.assert_allclose(normals, vertex_normals(frames[1], asset.faces), atol=1e-5)
    subsets = UsdGeom.Subset.GetAllGeomSubsets(mesh)
    covered = np.concatenate([np.array(each.GetIndicesAttr().Get()) for each in subsets])
    assert sorted(covered) == list(range(108)) and [len(each.GetIndicesAttr().Get()) for each in subsets] == [84, 24]
    textures = []
    for each in subsets:
        material = UsdShade.MaterialBindingAPI(each.GetPrim()).ComputeBoundMaterial()[0]
        surface = material.ComputeSurfaceSource()[0]
        assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
        if source := surface.GetInput("diffuseColor").GetConnectedSources()[0]:
            textures.append(UsdShade.Shader(source[0].source.GetPrim()).GetInput("file").Get().path)
    assert textures and all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for name in textures)
    assert all(other.read_bytes() == b"of another file" for other in others)
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_gif_read_back(tmp_path):
    path = tm.save_animation(FRAMES[:2], FACES, tmp_path / "a.gif", duration=0.4, fps=10, ping_pong=True, size=160)
    image = Image.open(path)
    assert image.n_frames == 8 and image.info["loop"] == 0 and image.info["duration"] == 100
    assert max(image.size) == 160
    pictures = []
    for number in range(8):
        image.seek(number)
        pictures.append(np.asarray(image.convert("RGB"), dtype=float))
    assert np.abs(pictures[0] - pictures[4]).mean() > 1  # it moves
    assert np.abs(pictures[1] - pictures[7]).mean() < 0.5  # and comes back
    assert (pictures[0] < 250).any(axis=2).mean() > 0.1  # there is something to see


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_textures_are_drawn(tmp_path, suffix):
    """A square of two triangles seen from the front: each quarter has the colour of its quarter of the picture."""
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[:] = [[(200, 0, 0), (0, 200, 0)], [(0, 0, 200), (200, 200, 0)]]
    Image.fromarray(texture).save(tmp_path / "skin.png")
    (tmp_path / "a.mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd skin.png\n")
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{corners}usemtl skin\nf 1/1 2/2 3/3 4/4\n")
    asset = tm.open_asset(tmp_path / "a.obj")
    if suffix == "glb":
        (path,) = tm.save_mesh(asset.positions, asset.faces, tmp_path / "a.glb", asset=asset)
        asset = tm.open_asset(path)
    path = tm.save_animation(asset.positions[None], asset.faces, tmp_path / "a.gif", asset=asset, size=120)
    picture = np.asarray(Image.open(path).convert("RGB"), dtype=float)
    assert max(picture.shape) == 120
    shown = (picture.min(-1) < 240).nonzero()
    rows, columns = ((np.quantile(each, [0.25, 0.75])).astype(int) for each in shown)
    for row, line in zip(rows, texture, strict=True):
        for column, color in zip(columns, line, strict=True):
            seen = picture[row, column]
            assert ((seen > 60) == (color > 0)).all(), (row, column, seen, color)
    (tmp_path / "skin.png").write_bytes((tmp_path / "skin.png").read_bytes()[:40])
    if suffix == "obj":
        with pytest.warns(MeshWarning, match="texture of 'skin' cannot be read"):
            tm.save_animation(asset.positions[None], asset.faces, path, asset=tm.open_asset(tmp_path / "a.obj"))
    with pytest.raises(ValueError, match="size must be a number of pixels, 2 or more"):
        tm.save_animation(FRAMES[:1], FACES, tmp_path / "b.gif", size=1)


def test_mp4_read_back(tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed")
    import imageio.v2 as imageio

    path = tm.save_animation(FRAMES[:2], FACES, tmp_path / "a.mp4", duration=1, fps=8, size=160)
    with imageio.get_reader(path) as reader:
        meta = reader.get_meta_data()
        pictures = [np.asarray(picture, dtype=float) for picture in reader]
    assert meta["codec"] == "h264" and meta["fps"] == 8 and len(pictures) == 9
    assert max(meta["size"]) == 160 and not any(side % 2 for side in meta["size"])
    assert np.abs(pictures[0] - pictures[-1]).mean() > 1


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_usd_to_a_full_disk(tmp_path, suffix):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    resource = pytest.importorskip("resource", reason="this system has no limit on the size of files")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (512, before[1]))
    try:
        with pytest.raises(OSError, match=rf"writing file.*a\.{suffix}") as caught:
            tm.save_animation(FRAMES, FACES, tmp_path / f"a.{suffix}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.__suppress_context__ and not list(tmp_path.iterdir())


@pytest.mark.parametrize(("suffix", "extra"), [("mp4", "video"), ("usdc", "usd")])
def test_missing_packages_are_named_before_the_work(tmp_path, monkeypatch, suffix, extra):
    for name in ("imageio", "pxr"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingPackageError, match=rf"pip install 'torch_modal\[{extra}\]'"):
        ANIMATION_FORMATS[f".{suffix}"].check_installed("a")
    with pytest.raises(MissingPackageError):
        tm.save_animation(FRAMES, FACES, tmp_path / f"a.{suffix}")
    ANIMATION_FORMATS[".glb"].check_installed("a.glb")


@pytest.mark.parametrize("suffix", ["mdd", "pc2", "npz", "usda", "gif"])
def test_one_frame_and_another_in_its_place(tmp_path, suffix):
    if suffix == "usda":
        pytest.importorskip("pxr")
    path = tm.save_animation(FRAMES[:1], FACES, tmp_path / "new" / f"a.{suffix}", size=160)
    before = path.read_bytes()
    tm.save_animation(FRAMES[1:], FACES, path, size=160)
    assert path.read_bytes() != before and list(path.parent.iterdir()) == [path]
