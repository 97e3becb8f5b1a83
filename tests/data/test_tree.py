"""Key-frame sets in a folder tree: their folders, their order."""

import os
from pathlib import Path
from typing import Any

from torch_modal.data.precompute import Options
from torch_modal.data.tree import find_keyframe_sets, mesh_files, natural


def make(root: Path, *files: str) -> Path:
    """Empty files below a folder."""
    for name in files:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("")
    return root


def test_sets_are_folders_with_two_meshes_or_more(tmp_path: Path) -> None:
    make(tmp_path, "a/1.obj", "a/2.OBJ", "b/c/x.ply", "b/c/y.ply", "b/c/z.ply", "b/c/notes.txt", "b/c/skin.mtl")
    make(tmp_path, "single/one.off", "texts/readme.txt", "a/texture.png", "loose.stl", "mixed/1.glb", "mixed/2.stl")
    sets, left_out = find_keyframe_sets(tmp_path, tmp_path / "out")
    assert sets == ["a", "b/c", "mixed"]
    reason = "it holds one mesh only; a set needs two or more"
    assert sorted(left_out) == [f"left out .: {reason}", f"left out single: {reason}"]


def test_hidden_files_folders_and_the_output_are_passed_over(tmp_path: Path) -> None:
    make(tmp_path, "a/1.obj", "a/2.obj", "a/._1.obj", ".trash/1.obj", ".trash/2.obj", "b/1.obj", "b/.2.obj")
    make(tmp_path, "out/c/1.obj", "out/c/2.obj")
    sets, left_out = find_keyframe_sets(tmp_path, skip=tmp_path / "b" / ".." / "out")
    assert sets == ["a"] and [line.split()[2] for line in left_out] == ["b:"]
    assert [file.name for file in mesh_files(tmp_path / "a")] == ["1.obj", "2.obj"]


def test_order_is_natural(tmp_path: Path) -> None:
    make(tmp_path, "s10/k.obj", "s10/l.obj", "s9/frame-10.obj", "s9/frame-9.obj", "s9/Frame-9b.obj", "s9/frame.obj")
    assert find_keyframe_sets(tmp_path, tmp_path / "out")[0] == ["s9", "s10"]
    names = [file.name for file in mesh_files(tmp_path / "s9")]
    assert names == ["frame-9.obj", "Frame-9b.obj", "frame-10.obj", "frame.obj"]
    assert sorted(["b", "a/2", "a/10", "a", "B"], key=natural) == ["a", "a/2", "a/10", "B", "b"]
    assert sorted(["x²", "x1", "x"], key=natural) == ["x", "x1", "x²"]  # a digit that is no number to int()


def test_links_are_followed_but_not_in_circles(tmp_path: Path) -> None:
    make(tmp_path, "elsewhere/1.obj", "elsewhere/2.obj", "root/a/1.obj", "root/a/2.obj")
    (tmp_path / "root" / "linked").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    (tmp_path / "root" / "a" / "up").symlink_to(tmp_path / "root", target_is_directory=True)
    (tmp_path / "root" / "a" / "gone.obj").symlink_to(tmp_path / "nowhere.obj")
    (tmp_path / "root" / "a" / "loop.obj").symlink_to("loop.obj")
    (tmp_path / "root" / "loop").symlink_to("loop", target_is_directory=True)
    assert find_keyframe_sets(tmp_path / "root", tmp_path / "out")[0] == ["a", "linked"]
    assert len(mesh_files(tmp_path / "root" / "a")) == 2


def test_key_depends_on_names_content_and_options(tmp_path: Path) -> None:
    def key(**options: Any) -> str:
        return Options(**options).key(mesh_files(tmp_path / "s"))

    make(tmp_path, "s/1.obj", "s/2.obj", "s/notes.txt", "s/times.txt")
    first = key()
    (tmp_path / "s" / "notes.txt").write_text("says nothing about the shape")
    (tmp_path / "s" / "times.txt").write_text("nor does this, unless it is a sequence")
    os.utime(tmp_path / "s" / "1.obj", (0, 0))
    assert key(timeout=5.0, overwrite=True) == first
    in_time = key(sequence=True)
    (tmp_path / "s" / "times.txt").write_text("0 2")
    seen = {first, in_time, key(sequence=True), key(n_modes=40), key(method="shell"), key(mesher="tetwild")}
    for change in (
        lambda: (tmp_path / "s" / "1.obj").write_text("v 0 0 0"),
        lambda: (tmp_path / "s" / "2.obj").rename(tmp_path / "s" / "3.obj"),
        lambda: (tmp_path / "s" / "4.gltf").write_text("{}"),
        lambda: (tmp_path / "s" / "4.bin").write_text("the vertices of 4.gltf"),
    ):
        change()
        seen.add(key())
    assert len(seen) == 10
