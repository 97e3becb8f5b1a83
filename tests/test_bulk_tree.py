"""What counts as a set of key-frames in a folder tree, in which order, and where its bases go."""

import json
import os
from pathlib import Path

import pytest

from torch_modal.bulk import records as r
from torch_modal.bulk.records import Record, Records
from torch_modal.bulk.tree import find_keyframe_sets, mesh_files, natural, places, same_stems


def make(root: Path, *files: str) -> Path:
    """Empty files below a folder."""
    for name in files:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("")
    return root


def test_sets_are_folders_with_two_meshes_or_more(tmp_path: Path) -> None:
    make(tmp_path, "a/1.obj", "a/2.OBJ", "b/c/x.ply", "b/c/y.ply", "b/c/z.ply", "b/c/notes.txt", "b/c/skin.mtl")
    make(tmp_path, "single/one.off", "texts/readme.txt", "a/texture.png", "loose.stl", "mixed/1.glb", "mixed/2.stl")
    tree = find_keyframe_sets(tmp_path)
    assert tree.sets == ["a", "b/c", "mixed"]  # that STL is refused is said when the set is worked on
    assert tree.left_out == {
        ".": "holds one mesh only, loose.stl; a set needs two or more",
        "single": "holds one mesh only, one.off; a set needs two or more",
    }


def test_hidden_files_folders_and_the_output_are_passed_over(tmp_path: Path) -> None:
    make(tmp_path, "a/1.obj", "a/2.obj", "a/._1.obj", ".trash/1.obj", ".trash/2.obj", "b/1.obj", "b/.2.obj")
    make(tmp_path, "out/c/1.obj", "out/c/2.obj")
    tree = find_keyframe_sets(tmp_path, skip=tmp_path / "b" / ".." / "out")
    assert tree.sets == ["a"]
    assert list(tree.left_out) == ["b"]
    assert [file.name for file in mesh_files(tmp_path / "a")] == ["1.obj", "2.obj"]


def test_order_is_natural(tmp_path: Path) -> None:
    make(tmp_path, "s10/k.obj", "s10/l.obj", "s9/frame-10.obj", "s9/frame-9.obj", "s9/Frame-9b.obj", "s9/frame.obj")
    assert find_keyframe_sets(tmp_path).sets == ["s9", "s10"]
    names = [file.name for file in mesh_files(tmp_path / "s9")]
    assert names == ["frame-9.obj", "Frame-9b.obj", "frame-10.obj", "frame.obj"]
    assert sorted(["b", "a/2", "a10", "a/10", "a", "a2"], key=natural) == ["a", "a/2", "a/10", "a2", "a10", "b"]
    assert sorted(["x²", "x1", "x"], key=natural) == ["x", "x1", "x²"]  # a digit that is no number to int()


def test_links_are_followed_but_not_in_circles(tmp_path: Path) -> None:
    make(tmp_path, "elsewhere/1.obj", "elsewhere/2.obj", "root/a/1.obj", "root/a/2.obj")
    (tmp_path / "root" / "linked").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    (tmp_path / "root" / "a" / "up").symlink_to(tmp_path / "root", target_is_directory=True)
    (tmp_path / "root" / "a" / "gone.obj").symlink_to(tmp_path / "nowhere.obj")
    assert find_keyframe_sets(tmp_path / "root").sets == ["a", "linked"]
    assert len(mesh_files(tmp_path / "root" / "a")) == 2


def test_folders_that_cannot_be_read_are_told(tmp_path: Path) -> None:
    make(tmp_path, "a/1.obj", "a/2.obj", "locked/1.obj")
    (tmp_path / "locked").chmod(0)
    if not os.access(tmp_path / "locked", os.R_OK):  # root may read anything
        assert find_keyframe_sets(tmp_path).left_out == {"locked": "cannot be read: Permission denied"}
    (tmp_path / "locked").chmod(0o700)
    with pytest.raises(FileNotFoundError):
        find_keyframe_sets(tmp_path / "missing")


def test_places_mirror_the_tree(tmp_path: Path) -> None:
    root = tmp_path / "shapes"
    assert places(["a", "b/c"], root) == {"a": "a", "b/c": "b/c"}
    # The output folder has the report in it; a folder with sets below it cannot be replaced as a whole.
    assert places([".", "a", "a/b/c", "ab"], root) == {".": "shapes", "a": "a/a", "a/b/c": "a/b/c", "ab": "ab"}
    assert places(["."], Path("/")) == {".": "root"}
    taken = places([".", "a", "a/a", "a/a_/b", "shapes/b"], root)
    assert taken == {".": "shapes_", "a": "a/a__", "a/a": "a/a", "a/a_/b": "a/a_/b", "shapes/b": "shapes/b"}
    assert len(set(taken.values())) == 5


def test_one_shape_in_two_formats() -> None:
    files = [Path(name) for name in ("a.obj", "b.obj", "a.ply")]
    assert same_stems(files) == [files[0], files[2]]
    assert same_stems(files[:2]) == []


def test_key_depends_on_names_and_content(tmp_path: Path) -> None:
    make(tmp_path, "s/1.obj", "s/2.obj", "s/notes.txt")
    first = r.inputs_key(mesh_files(tmp_path / "s"))
    (tmp_path / "s" / "notes.txt").write_text("says nothing about the shape")
    os.utime(tmp_path / "s" / "1.obj", (0, 0))
    assert r.inputs_key(mesh_files(tmp_path / "s")) == first
    seen = {first}
    for change in (
        lambda: (tmp_path / "s" / "1.obj").write_text("v 0 0 0"),
        lambda: (tmp_path / "s" / "2.obj").rename(tmp_path / "s" / "3.obj"),
        lambda: (tmp_path / "s" / "4.gltf").write_text("{}"),
        lambda: (tmp_path / "s" / "4.bin").write_text("the vertices of 4.gltf"),
    ):
        change()
        seen.add(r.inputs_key(mesh_files(tmp_path / "s")))
    assert len(seen) == 5


def test_record_comes_back_and_a_damaged_one_is_none(tmp_path: Path) -> None:
    records = Records(tmp_path)
    records.prepare()
    record = Record(
        "a\udcff/ü\n", r.CRASHED, "why", "place/" + "x" * 300, 1.5, 3, 90, ["1.obj"], inputs="ab", ours=True
    )
    records.write(record)
    assert records.read(record.output) == record
    assert records.read("a") is None
    (file,) = (tmp_path / r.STATE / "sets").iterdir()
    for damaged in ("", "[]", "{", '{"set": "a"}', '{"set": "a", "status": "done", "colour": 1}'):
        file.write_text(damaged)
        assert records.read(record.output) is None


def test_report_has_a_line_for_each_set_in_order(tmp_path: Path) -> None:
    records = Records(tmp_path)
    records.prepare()
    assert records.is_own_report()
    records.write(Record("b", r.DONE, output="b", seconds=2.0))
    records.write(Record("a", r.STARTED, output="a/a"))
    found = records.write_report({"b": "b", "a": "a/a", "c": "c"}, {"d": "holds one mesh only"})
    assert [record.status for record in found] == ["done", "unfinished", "unfinished"]
    lines = [json.loads(line) for line in records.report.read_text().splitlines()]
    assert [(line["set"], line["status"]) for line in lines] == [
        ("b", "done"),
        ("a", "unfinished"),
        ("c", "unfinished"),
        ("d", "left out"),
    ]
    assert lines[0]["seconds"] == 2.0 and lines[3]["reason"] == "holds one mesh only"
    assert records.is_own_report()
    for foreign in ("my notes", '{"a": 1}', "[1]"):
        records.report.write_text(foreign)
        assert not records.is_own_report()


def test_what_changed_names_the_options() -> None:
    old = Record("a", r.DONE, inputs="1", parameters={"n_modes": 30, "mesher": "auto"})
    assert r.what_changed(old, "1", {"mesher": "auto", "n_modes": 30}) == ""
    assert r.what_changed(old, "2", {"mesher": "auto", "n_modes": 40}) == (
        "its files changed, n_modes changed from 30 to 40"
    )
