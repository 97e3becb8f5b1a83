"""A test for each row of docs/input.md on arrays; test_keyframe_files.py has those on files."""

import re
import warnings

import numpy as np
import pytest
import torch
import trimesh
from helpers.bodies import twisted_plate
from helpers.cube import CUBE, CUBE_FACES, TWO, edge_directions_oppose

from torch_modal.geometry import inspect
from torch_modal.geometry.inspect import volume_of
from torch_modal.geometry.rigid import looks_mirrored
from torch_modal.keyframes.arrays import check_tensor
from torch_modal.keyframes.check import Keyframes, MeshError, MeshWarning, check_keyframes
from torch_modal.modes.surface import CanonicalSurface
from torch_modal.registration.load import load_keyframes

pytestmark = pytest.mark.filterwarnings("error")  # a warning that no test asks for is a failure


# ---------------------------------------------------------------- arrays: types and shapes


def test_good_input_passes_untouched_and_silently():
    positions = torch.tensor(TWO, requires_grad=True)
    result = check_keyframes(positions, torch.tensor(CUBE_FACES))
    assert isinstance(result, Keyframes)
    assert result.keyframes is positions
    assert result.faces.dtype == torch.int64
    np.testing.assert_array_equal(result.faces, CUBE_FACES)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, ">f8"])
def test_numpy_positions(dtype):
    array = TWO.astype(dtype)
    array.setflags(write=False)
    result = check_keyframes(array, CUBE_FACES.tolist())
    assert result.keyframes.dtype == (torch.float32 if dtype == np.float32 else torch.float64)
    np.testing.assert_array_equal(result.keyframes, array)
    np.testing.assert_array_equal(check_keyframes(array[::-1], CUBE_FACES).keyframes, array[::-1])


def test_sequence_of_shapes():
    x = torch.tensor(CUBE, requires_grad=True)
    result = check_keyframes([x, 2 * x], CUBE_FACES)
    np.testing.assert_array_equal(result.keyframes.detach(), np.stack([CUBE, 2 * CUBE]))
    result.keyframes.sum().backward()
    assert torch.equal(x.grad, torch.full((8, 3), 3.0, dtype=torch.float64))


@pytest.mark.parametrize("dtype", ["int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"])
def test_faces_of_any_integer_type(dtype):
    faces = check_keyframes(TWO, CUBE_FACES.astype(dtype)).faces
    assert faces.dtype == torch.int64
    np.testing.assert_array_equal(faces, CUBE_FACES)


def changed(array, *changes):
    """A copy with other values at some places."""
    copy = array.copy()
    for place, value in changes:
        copy[place] = value
    return copy


POINT = changed(TWO, (1, 3.0))
NO_ARRAYS = [None, "abc", [["a", "b"]], object(), {"a": 1}, [None, None]]
BAD_SHAPES = [TWO[..., :2], TWO[None], TWO[0, 0], np.float64(1)]
OTHER_DTYPES = [torch.float16, torch.bfloat16, torch.int64, torch.bool, torch.complex128]
BEYOND = [(TWO * f).astype(t) for t, f in (("f4", 1e-32), ("f4", 1e32), ("f8", 1e-300), ("f8", 1e300))]
BEYOND += [(TWO[:1] - 0.5) * 2 * 1.5e308]  # whose extent overflows


@pytest.mark.parametrize(
    ("keyframes", "faces", "match"),
    [
        # types
        *((torch.tensor(TWO).to(t), CUBE_FACES, rf"dtype {t}; .* float32 or .*\.double\(\)") for t in OTHER_DTYPES),
        *((value, CUBE_FACES, "no array of numbers") for value in NO_ARRAYS),
        *((TWO, value, "faces is a .* no array of numbers") for value in NO_ARRAYS),
        (torch.empty(2, 8, 3, device="meta"), CUBE_FACES, "dense tensor with values"),
        *(
            (TWO, CUBE_FACES.astype(t), r"faces have dtype torch\.\w+; .* convert with \.long")
            for t in ("f8", "?", "c16")
        ),
        (TWO, np.array([[0, 1, 2**64 - 1]], dtype=np.uint64), "faces use vertices that do not exist"),
        ([CUBE, CUBE.astype(np.float32)], CUBE_FACES, "key-frame 1 has .*torch.float32, .* 0 has .*torch.float64"),
        # shapes
        ([CUBE, CUBE[:7]], CUBE_FACES, r"key-frame 1 has shape \(7, 3\), .* key-frame 0 has shape \(8, 3\), "),
        ([], CUBE_FACES, "keyframes is empty"),
        (CUBE, CUBE_FACES, r"shape \(8, 3\); .* pass keyframes\[None\]"),
        *((bad, CUBE_FACES, r"keyframes have shape .*; \(K, V, 3\) is needed") for bad in BAD_SHAPES),
        *((TWO, bad, r"faces have shape .*; \(F, 3\) is needed") for bad in (CUBE_FACES[:, :2], CUBE_FACES[None])),
        (TWO, np.zeros((6, 4), dtype=int), r"\(6, 4\); .* along one diagonal"),
        (np.zeros((2, 0, 3)), CUBE_FACES, "12 faces use vertices .* with 0 vertices"),
        *((TWO, none, "triangles, at least one") for none in ([], np.zeros((0, 3), dtype=int))),
        # values
        *(
            (
                changed(TWO, ((1, 5, 2), bad), ((1, 7, 0), bad), ((1, 7, 1), bad)),
                CUBE_FACES,
                "^2 vertices have NaN or infinite .* vertex 5 of key-frame 1",
            )
            for bad in (np.nan, np.inf, -np.inf)
        ),
        *(
            (TWO, changed(CUBE_FACES, ((3, 1), i)), rf"^1 faces .* face 3, vertices \[4, {i}, 5\], with 8 vertices$")
            for i in (8, -1, 2**62)
        ),
        (TWO, CUBE_FACES + 1, "indices count from 0, not from 1"),
        (TWO, [[0, 0, 1], [1, 2, 2]], "all faces use a vertex twice"),
        # sizes
        (POINT, CUBE_FACES, "key-frame 1 .* cannot compute with"),
        (0 * TWO, CUBE_FACES, "key-frame 0 has a bounding-box diagonal of 0 "),
        ((TWO + 4e6).astype(np.float32), CUBE_FACES, "key-frame 0 .* torch.float32 cannot compute with"),
        (TWO + 4e12, CUBE_FACES, "key-frame 0 .* torch.float64 cannot compute with"),
        # a vertex of no face gives no size
        (
            np.concatenate([POINT, TWO[:, :1] + 1], axis=1),
            CUBE_FACES,
            "key-frame 1 .* cannot compute with",
        ),
        *((x, CUBE_FACES, "cannot compute with: choose another unit") for x in BEYOND),
        (
            np.stack([10 * CUBE, CUBE, 101 * CUBE]),
            CUBE_FACES,
            "key-frame 2 .* 1 .* 100 times as .*different units",
        ),
        (
            np.stack([CUBE, CUBE + 7, CUBE * [-1, 1, 1] + 3]),
            CUBE_FACES,
            "key-frame 2 is mirrored: .* key-frame 0.* mirror it back",
        ),
    ],
)
def test_arrays_that_are_refused(keyframes, faces, match):
    """Silencing warnings silences no error."""
    with pytest.raises(MeshError, match=match):
        check_keyframes(keyframes, faces, warn=False)


@pytest.mark.parametrize(
    "keyframes",
    [
        *(TWO * f for f in (1e-20, 1e-3, 1e3, 1e20)),
        *((TWO * f).astype(np.float32) for f in (1e-20, 1e20)),
        TWO + 1e6,
        np.stack([CUBE, 99 * CUBE]),
        np.stack([CUBE, CUBE * [-1, -1, 1] + 3]),  # half a turn is no mirror
    ],
)
def test_any_unit_place_and_turn_is_silent(keyframes):
    check_keyframes(keyframes, CUBE_FACES)


def test_too_few_keyframes_are_refused():
    check_keyframes(TWO[:1], CUBE_FACES)
    with pytest.raises(MeshError, match=r"1 key-frame\(s\) arrived, at least 2 are needed"):
        check_keyframes(TWO[:1], CUBE_FACES, min_keyframes=2)
    with pytest.raises(MeshError, match=r"0 key-frame\(s\) arrived, at least 1"):
        check_keyframes(TWO[:0], CUBE_FACES, min_keyframes=0)


# ---------------------------------------------------------------- warnings


def test_equal_key_frames_in_a_row_are_said_once():
    text = "1 key-frames are equal to the one before; the first is key-frame 2$"
    with pytest.warns(MeshWarning, match=text) as said:
        check_keyframes(TWO[[0, 1, 1, 0]], CUBE_FACES)
    assert len(said) == 1
    check_keyframes(TWO[[0, 1, 0]], CUBE_FACES)
    check_keyframes(TWO[[0, 0]], CUBE_FACES, warn=False)


SEAM = np.concatenate([CUBE, CUBE[[1, 7, 3]]])[None], changed(CUBE_FACES, (-1, [8, 9, 10]))  # was [1, 7, 3]


@pytest.mark.parametrize(
    ("keyframes", "faces", "messages", "kept"),
    [
        (
            TWO,
            np.insert(CUBE_FACES, 2, [[4, 4, 1], [2, 3, 2]], axis=0),
            [r"^2 faces use a vertex twice .* face 2, \[4, 4, 1\]$"],
            CUBE_FACES,
        ),
        (
            TWO,
            np.concatenate([[[2, 2, 1]], CUBE_FACES, [[3, 0, 1], [3, 1, 0]]]),
            [
                "^1 faces use a vertex twice and were dropped",
                r"^2 faces have the same vertices as an earlier face and were dropped.*face 13, \[3, 0, 1\]$",
            ],
            CUBE_FACES,
        ),
        # a tie of windings keeps the first face
        (TWO, [[0, 1, 3], [0, 2, 3]], ["1 faces wind against their neighbours", "", "open"], [[0, 1, 3], [3, 2, 0]]),
        (TWO, [[0, 3, 1], [0, 3, 2]], ["1 faces wind against their neighbours", "", "open"], [[0, 3, 1], [2, 3, 0]]),
        (
            np.concatenate([CUBE, [[0.5, 0.5, 3]]])[None],
            np.concatenate([CUBE_FACES, [[0, 1, 8]]]),
            [r"1 edges join three or more faces.*not bending.*the first is edge \[0, 1\]", ""],
            None,
        ),
        (TWO, CUBE_FACES[:-1], ["3 edges belong to one face only: the surface is open"], None),
        (*SEAM, ["6 edges .* open; .* 6 of its vertices lie exactly .*weld_seams joins them"], None),
        (
            np.concatenate([TWO, np.full((2, 2, 3), 1e300)], axis=1),
            CUBE_FACES,
            ["^2 vertices belong to no face: they follow .* vertex 8$"],
            None,
        ),
        (
            changed(TWO, ((1, 3), (TWO[1, 0] + TWO[1, 1]) / 2)),
            CUBE_FACES,
            [r"^1 faces have no area .* face \[0, 1, 3\] in key-frame 1$"],
            None,
        ),
        # shrunk to a point: the face itself and, beside its edges, one face each
        (changed(TWO, ((1, [1, 3]), TWO[1, 0])), CUBE_FACES, ["edges have no length", "^4 faces have no area"], None),
        (
            changed(TWO, ((1, 3), TWO[1, 1])),
            CUBE_FACES,
            [r"^1 edges have no length, t.*the first is edge \[1, 3\] in key-frame 1$", "^2 faces have no area in s"],
            None,
        ),
        (
            np.concatenate([TWO, TWO[:1] + 4096]).astype(np.float32),
            CUBE_FACES,
            ["^1 key-frames lie so far .* torch.float32 rounds .* float64, .* key-frame 2 "],
            None,
        ),
        # a mirror image of an open surface is not seen
        (np.stack([CUBE, CUBE * [-1, 1, 1]]), CUBE_FACES[:-1], ["open"], None),
        # one warning of a kind
        (
            np.concatenate([TWO, TWO]),
            np.concatenate([CUBE_FACES[:-3], [[2, 2, 1], [3, 3, 1]], CUBE_FACES[:2]]),
            ["^2 ", "^2 ", "open"],
            CUBE_FACES[:-3],
        ),
        # both silent
        (TWO, CUBE_FACES[:, ::-1], [], None),  # wound inwards
        (np.concatenate([TWO, TWO + 5], axis=1), np.concatenate([CUBE_FACES, CUBE_FACES + 8]), [], None),
    ],
)
def test_what_is_warned_of_and_which_faces_are_kept(keyframes, faces, messages, kept):
    faces, copy = np.array(faces), np.array(faces)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = check_keyframes(keyframes, faces)
    said = [str(w.message) for w in caught]
    assert len(said) == len(messages) and all(re.search(*both) for both in zip(messages, said, strict=True)), said
    assert all(issubclass(w.category, MeshWarning) and w.filename == __file__ for w in caught)
    np.testing.assert_array_equal(result.faces, faces if kept is None else kept)
    assert result.keyframes.shape == keyframes.shape
    np.testing.assert_array_equal(faces, copy)
    # A second check finds nothing to mend, and warnings may be left out.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.equal(check_keyframes(*result, warn=False).faces, result.faces)


def test_inconsistent_winding_is_repaired():
    ball = trimesh.creation.icosphere(subdivisions=2)
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    vertices = np.concatenate([ball.vertices, ball.vertices + 5])[None]
    mixed = faces.copy()
    turned = np.random.default_rng(0).choice(len(faces), size=150, replace=False)
    mixed[turned] = mixed[turned, ::-1]
    with pytest.warns(MeshWarning, match=rf"^150 faces wind against .* face {turned.min()},"):
        repaired = check_keyframes(vertices, mixed).faces
    assert edge_directions_oppose(repaired)
    np.testing.assert_array_equal(np.sort(repaired), np.sort(faces))
    assert trimesh.Trimesh(vertices[0], repaired, process=False).volume == pytest.approx(2 * ball.volume)


def moebius(n=12):
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    middle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    across = 0.3 * np.stack(
        [np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)], axis=1
    )
    vertices = np.concatenate([middle - across, middle + across])
    i = np.arange(n)
    j = (i + 1) % n
    left, right = np.where(i < n - 1, j, j + n), np.where(i < n - 1, j + n, j)
    return vertices[None], np.concatenate([np.stack([i, i + n, left], 1), np.stack([i + n, right, left], 1)])


def test_non_orientable_is_warned_and_left():
    vertices, faces = moebius()
    with pytest.warns(MeshWarning, match=r"^24 faces belong to a surface that has no consistent winding"):
        with pytest.warns(MeshWarning, match=r"the surface is open"):
            result = check_keyframes(vertices, faces)
    np.testing.assert_array_equal(result.faces, faces)


# ---------------------------------------------------------------- shape


@pytest.mark.parametrize("thickness", [1e-4, 1e-3])
def test_a_thin_plate_whose_volume_turns_over_is_not_mirrored(thickness):
    flat, twisted, faces = twisted_plate(thickness)
    volumes = [volume_of(x, faces) / inspect.diagonals(x[None])[0] ** 3 for x in (flat, twisted)]
    assert volumes[0] > 1e-6 and volumes[1] < -1e-6
    both = check_keyframes(np.stack([flat, twisted]), faces)
    assert not looks_mirrored(both.keyframes[:1], both.keyframes[1:], both.faces).any()


def test_mirrored_bodies_in_any_pose_are_refused(data_dir):
    """After the best motion, most normals of a hand and its mirror image agree: it is flat."""
    keyframes, faces = load_keyframes(sorted((data_dir / "mh-hand").glob("*.obj")))
    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    turn = torch.from_numpy(trimesh.transformations.rotation_matrix(2.0, [1, 2, 3])[:3, :3])
    i, j = torch.cartesian_prod(*2 * [torch.arange(len(keyframes))]).T
    assert looks_mirrored(keyframes[i], (5 * mirror * keyframes[j]) @ turn + 3, faces).all()
    assert not looks_mirrored(keyframes[i], (5 * keyframes[j]) @ turn + 3, faces).any()
    with pytest.raises(MeshError, match="key-frame 1 is mirrored"):
        check_keyframes(torch.stack([keyframes[0], mirror * keyframes[2]]), faces)


def test_flat_surface_is_refused_only_where_a_solid_is_needed():
    grid = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    with pytest.warns(MeshWarning, match=r"open"):
        check_keyframes(grid[None], faces)
    turn = trimesh.transformations.rotation_matrix(1.0, [1, 2, 3])[:3, :3]
    stray = np.concatenate([grid @ turn.T + 5, [[0, 0, 9]]])  # a vertex of no face gives no thickness
    for flat in (grid, stray, grid * 1e9):
        with pytest.raises(MeshError, match=r"the surface is flat: its extents are .* give it a thickness"):
            CanonicalSurface(flat, faces).require_solid()
    with pytest.raises(MeshError, match="on a line: the extents are 1, 0 and 0"):
        CanonicalSurface(grid * [1, 0, 0] + [0, 0, 1], faces)
    CanonicalSurface(CUBE, CUBE_FACES).require_solid()
    CanonicalSurface(grid * 1e-9 + np.array([[0, 0, 1e-12]] + [[0, 0, 0]] * 3), faces).require_solid()


# ---------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    ("x", "sizes", "options", "said"),
    [
        ([[0.0] * 3], ("V", 3), {}, r"x is a list; pass a tensor, for instance torch.as_tensor\(x\)"),
        (torch.zeros(4, 3), (5, 3), {}, r"x must be floating-point of shape \(5, 3\); got \(4, 3\) of torch.float32$"),
        (torch.zeros(2, 4, 3), ("V", 3), {}, r"of shape \(V, 3\); got \(2, 4, 3\)"),
        (torch.zeros(3), ("...", "V", 3), {}, r"of shape \(\.\.\., V, 3\); got \(3,\)"),
        (torch.zeros(2, 5), ("...", 6), {"hint": "a turn and a move"}, r"got \(2, 5\) of torch.float32; a turn and a"),
        (torch.zeros(2), (3,), {}, r"of shape \(3,\); got \(2,\)"),
        (torch.zeros(4, 3, dtype=torch.int64), (4, 3), {}, "floating-point .* of torch.int64"),
        (torch.zeros(4, 3), (4, 3), {"device": torch.device("meta")}, "x is on cpu, the other tensors on meta; move"),
        (torch.full((4, 3), torch.nan), (4, 3), {"finite": True}, "x has entries that are not finite"),
    ],
)
def test_arguments_that_are_no_shapes_are_refused(x, sizes, options, said) -> None:
    with pytest.raises(ValueError, match=said):
        check_tensor("x", x, *sizes, **options)


@pytest.mark.parametrize(
    "sizes", [(2, 4, 3), ("K", 4, 3), ("...", 4, 3), ("...", 2, 4, 3), ("...", "V", 3), ("...", 3)]
)
def test_arguments_that_are_shapes_pass(sizes) -> None:
    check_tensor("x", torch.zeros(2, 4, 3), *sizes, device=torch.device("cpu"), finite=True)
