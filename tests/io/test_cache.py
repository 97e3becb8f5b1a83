"""The cache returns what was computed, or computes it; digests change with all that a result may depend on."""

import os
import subprocess
import sys
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torch_modal as tm
from torch_modal.elastic.stretch import Stretch
from torch_modal.io import cache as cache_module
from torch_modal.io.cache import Cache, CacheWarning, ContentError, content_digest, entry_name

POINTS = np.arange(6.0).reshape(2, 3)
RESULT = {
    "values": np.linspace(0, 1, 50),
    "index": np.arange(8).reshape(2, 4).T,
    "one": np.broadcast_to(0.5, 1),  # with a stride of 0
}


class Counted:
    """A computation that counts its calls."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> dict[str, np.ndarray]:
        self.calls += 1
        return RESULT


def get(folder: Path | None, compute: Counted, points: np.ndarray = POINTS, **parameters: float):
    return Cache(folder).get("thing", {"points": points}, parameters, compute)


def assert_right(found: dict[str, np.ndarray]) -> None:
    assert found.keys() == RESULT.keys()
    for name, array in RESULT.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


def test_computed_once_or_always(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compute = Counted()
    for _ in range(3):
        assert_right(get(tmp_path / "new" / "folder", compute, k=3))
    assert compute.calls == 1
    assert [path.suffix for path in (tmp_path / "new" / "folder").iterdir()] == [".safetensors"]
    monkeypatch.setenv("TORCH_MODAL_CACHE", str(tmp_path / "default"))
    for _ in range(2):
        assert_right(Cache.at(enabled=False).get("thing", {}, {}, compute))
    assert compute.calls == 3 and not (tmp_path / "default").exists()


def test_key_depends_on_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    keys = [
        entry_name("thing", {"points": POINTS}, {"k": 3}),
        entry_name("other", {"points": POINTS}, {"k": 3}),
        entry_name("thing", {"points": POINTS}, {"k": 4}),
        entry_name("thing", {"points": POINTS}, {"k": 3, "form": "x"}),
        entry_name("thing", {"points": POINTS + np.spacing(5.0)}, {"k": 3}),
        entry_name("thing", {"points": POINTS.reshape(3, 2)}, {"k": 3}),
        entry_name("thing", {"points": POINTS.view(np.int64)}, {"k": 3}),
        entry_name("thing", {"faces": POINTS}, {"k": 3}),
    ]
    monkeypatch.setattr(cache_module, "CACHE_VERSION", cache_module.CACHE_VERSION + 1)
    keys.append(entry_name("thing", {"points": POINTS}, {"k": 3}))
    assert len(set(keys)) == len(keys)
    assert entry_name("thing", {"points": np.asfortranarray(POINTS)}, {"k": 3}) == keys[-1]


def test_any_flipped_bit_and_any_cut_is_noticed(tmp_path: Path) -> None:
    compute = Counted()
    get(tmp_path, compute)
    (entry,) = tmp_path.iterdir()
    good = entry.read_bytes()
    random = np.random.default_rng(0)
    places = {0, 7, 8, 20, len(good) - 1, *random.integers(0, len(good), 100).tolist()}
    for place in places:
        bad = bytearray(good)
        bad[place] ^= 1 << int(random.integers(8))
        for damaged in (bad, good[:place]):
            entry.write_bytes(damaged)
            assert_right(get(tmp_path, compute))
            assert entry.read_bytes() == good, f"the entry with byte {place} changed, or cut there, was replaced"


def test_the_entry_of_another_computation_is_not_taken(tmp_path: Path) -> None:
    """A whole entry under the name of another, as of a folder that was copied by hand, is computed again."""
    other, compute = Counted(), Counted()
    get(tmp_path, other, POINTS + 1)
    (entry,) = tmp_path.iterdir()
    name = entry_name("thing", {"points": POINTS}, {})
    entry.rename(tmp_path / name)
    for calls in (1, 1):
        assert_right(get(tmp_path, compute))
        assert compute.calls == calls
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.warns(CacheWarning, match="TORCH_MODAL_CACHE or cache_dir"):
        assert_right(get(tmp_path / "file" / "folder", Counted()))


def test_default_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_MODAL_CACHE", os.path.join("~", "there"))
    assert Cache.at().folder == Path.home() / "there"
    monkeypatch.delenv("TORCH_MODAL_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", os.path.join(os.sep, "xdg"))
    assert Cache.at().folder == Path(os.sep, "xdg", "torch_modal")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert Cache.at().folder == Path.home() / ".cache" / "torch_modal"


# ------------------------------------------------------------------------------------------- the limit of its size
ENTRY = np.zeros(2**14)  # 128 KiB


def keep(cache: Cache, number: int) -> None:
    found = cache.get("thing", {}, {"number": number}, lambda: {"x": ENTRY + number})
    np.testing.assert_array_equal(found["x"], ENTRY + number)


def kept(cache: Cache, n: int) -> list[int]:
    """Which are there, without using them."""
    assert cache.folder is not None
    return [i for i in range(n) if (cache.folder / entry_name("thing", {}, {"number": i})).exists()]


def size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.iterdir())


def test_the_least_recently_used_make_room(tmp_path: Path) -> None:
    cache = Cache(tmp_path, limit=10 * 2**17 + 10 * 2**10)  # ten of them, with their heads
    for i in range(10):
        keep(cache, i)
    assert kept(cache, 10) == list(range(10))
    keep(cache, 0)
    keep(cache, 10)
    assert kept(cache, 11) == [0, *range(2, 11)], "the first was used last"
    assert size_of(tmp_path) <= cache.limit


def test_an_entry_above_the_limit_is_kept_alone_beside_files_of_others(tmp_path: Path) -> None:
    cache = Cache(tmp_path, limit=1000)
    keep(cache, 0)
    assert kept(cache, 1) == [0]
    (entry,) = tmp_path.iterdir()
    others = [tmp_path / "mine.safetensors", tmp_path / f".{entry.name}.1-a.tmp"]
    for path in others:
        path.write_bytes(bytes(2000))
    keep(cache, 1)
    assert all(path.exists() for path in others)
    assert kept(cache, 2) == [1]


def test_an_entry_that_is_removed_while_it_is_opened_is_computed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = Cache(tmp_path)
    keep(cache, 0)
    (entry,) = tmp_path.iterdir()
    reopen = torch.UntypedStorage.from_file

    def removed(*arguments: object, **options: object) -> object:  # safetensors opens the file, and then torch
        entry.unlink(missing_ok=True)
        return reopen(*arguments, **options)

    monkeypatch.setattr(torch.UntypedStorage, "from_file", removed)
    keep(cache, 0)
    assert entry.exists()


WRITER = """
import sys, warnings
import numpy as np
from pathlib import Path
from torch_modal.io.cache import Cache
warnings.simplefilter("error")
cache = Cache(Path(sys.argv[1]), limit=5 * 2**17)
for i in range(60):
    number = (i * int(sys.argv[2])) % 23
    arrays = cache.get("thing", {}, {"number": number}, lambda: {"x": np.zeros(2**14) + number})
    assert (arrays["x"] == number).all()
"""


def test_several_processes_share_the_limit(tmp_path: Path) -> None:
    root = str(Path(cache_module.__file__).parents[2])
    command = [sys.executable, "-c", WRITER, str(tmp_path)]
    writers = [
        subprocess.Popen([*command, str(step)], env={**os.environ, "PYTHONPATH": root}, stderr=subprocess.PIPE)
        for step in (3, 5, 7)
    ]
    failures = [writer.communicate(timeout=120)[1].decode() for writer in writers]
    assert [writer.returncode for writer in writers] == [0, 0, 0], failures
    assert 0 < size_of(tmp_path) <= 5 * 2**17


def test_the_limit_is_a_number_of_bytes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TORCH_MODAL_CACHE_LIMIT", "1.5e9")
    assert Cache.at(tmp_path).limit == 1.5e9
    monkeypatch.setenv("TORCH_MODAL_CACHE_LIMIT", "500M")
    with pytest.raises(ValueError, match="TORCH_MODAL_CACHE_LIMIT is a number of bytes, got '500M'"):
        Cache.at(tmp_path)


# --------------------------------------------------------------------------------------------------------- digests
class Own(tm.Term):
    """A term of a user."""


def long(last: float) -> torch.Tensor:
    """A tensor whose repr leaves out most numbers."""
    x = torch.zeros(2000)
    x[1000] = last
    return x


def stretch(stiffness: Any = 1.0, **attributes: Any) -> Stretch:
    term = Stretch(stiffness)
    vars(term).update(attributes)
    return term


DIFFERENT: dict[str, tuple[Any, Any]] = {
    "a term's stiffness": (stretch(2.0), stretch(3.0)),
    "a term's buffer": (stretch(long(2.0)), stretch(long(3.0))),
    "a term's parameter": (stretch(torch.nn.Parameter(long(2.0))), stretch(torch.nn.Parameter(long(3.0)))),
    "an attribute with an underscore": (stretch(_c=2.0), stretch(_c=3.0)),
    "a class": (Stretch(), tm.Objective().all_terms()[1]),
    "a type of numbers": (torch.zeros(2), torch.zeros(2, dtype=torch.float64)),
    "a shape": (np.zeros((2, 3)), np.zeros((3, 2))),
    "fields": (np.zeros(1, dtype=[("a", "<i4")]), np.zeros(1, dtype=[("a", "<f4")])),
    "the last digit": (1.0, float(np.nextafter(1.0, 2.0))),
    "a kind of number": (1, 1.0),
    "a truth": (1, True),
    "a kind of list": ([1, 2], (1, 2)),
    "nesting": ([[1], 2], [[1, 2]]),
    "an order": ({"a": 1, "b": 2}, {"b": 2, "a": 1}),
    "values deep inside": ([{"b": OrderedDict(c=long(2.0))}], [{"b": OrderedDict(c=long(3.0))}]),
    "settings": (tm.Objective(beta=2.0), tm.Objective(beta=3.0)),
    "terms of settings": (tm.Objective(terms=(stretch(2.0),)), tm.Objective(terms=(stretch(3.0),))),
    "bfloat16": (torch.zeros(2, dtype=torch.bfloat16), torch.ones(2, dtype=torch.bfloat16)),
    "a conjugate": (torch.tensor([1j]), torch.tensor([1j]).conj()),
}


@pytest.mark.parametrize("what", DIFFERENT)
def test_what_differs_has_another_digest(what: str) -> None:
    first, second = (content_digest(value) for value in DIFFERENT[what])
    assert first != second


def test_what_is_equal_has_the_same() -> None:
    pairs = [
        (stretch(long(2.0)), stretch(long(2.0))),
        (long(2.0), torch.stack([long(2.0), long(2.0)], 1)[:, 0]),
        (np.arange(6.0).reshape(2, 3), np.arange(6.0).reshape(2, 3).copy(order="F")),
        ({"a", "b", "c"}, {"c", "b", "a"}),
        (tm.Objective(alpha=np.float64(5.0)), tm.Objective(alpha=np.float64(5.0))),
    ]
    for first, second in pairs:
        assert content_digest(first) == content_digest(second)


def test_the_same_in_another_process() -> None:
    code = (
        "import torch, torch_modal as tm\n"
        "from torch_modal.io.cache import content_digest\n"
        "print(content_digest([{'a', 'bb', 'ccc'}, tm.Objective(alpha=torch.tensor([2.0]))]))\n"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.strip() == content_digest([{"a", "bb", "ccc"}, tm.Objective(alpha=torch.tensor([2.0]))])


def disguised() -> tm.Term:
    """A term whose class has the name and the module of another one's."""
    other = type("Stretch", (Stretch,), {})
    other.__module__ = Stretch.__module__
    return other(1.0)  # type: ignore[no-any-return]


def hooked() -> tm.Term:
    term = Stretch(1.0)
    term.register_forward_hook(lambda module, args, output: 2 * output)
    return term


def circle() -> list[Any]:
    values: list[Any] = []
    values.append(values)
    return values


@pytest.mark.parametrize(
    "value",
    [
        threading.Lock(),
        (n for n in "abc"),
        sys.stdout,
        torch.zeros(2, device="meta"),
        torch.zeros(2).to_sparse(),
        np.array([{}], dtype=object),
        lambda x: x,
        Own(2.0),
        tm.Objective(terms=(Own(2.0),)),
        stretch(measure=lambda spokes: 2 * spokes[0].norm()),
        disguised(),
        hooked(),
        circle(),
    ],
)
def test_what_is_not_plain_data_is_refused(value: Any) -> None:
    with pytest.raises(ContentError):
        content_digest([value])


def test_tensors_inside_a_transform_are_refused() -> None:
    with pytest.raises(ContentError):
        torch.func.vmap(lambda x: torch.tensor(len(content_digest(x))))(torch.zeros(2, 3))
