"""OFF: the lines of the file, with other numbers in the place of positions."""

import re
from pathlib import Path

import numpy as np

from torch_modal.arrays import FloatArray
from torch_modal.io.asset import Asset, Material, Part, linear
from torch_modal.io.bare_mesh import off_bytes, read_triangles


class OffAsset(Asset):
    """An OFF file, kept as lines: colours, polygons and further numbers of vertices stay."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        text = path.read_bytes().decode("utf-8", errors="surrogateescape")
        counts = re.sub(r"^\s*\w*OFF", "", re.sub(r"#[^\n]*", "", text[: 1 << 16])).split()[:2]
        known = len(counts) == 2 and all(word.isdigit() for word in counts)
        self.positions, self.faces = read_triangles(path, *map(int, counts if known else (0, 0)))
        self.lines = text.splitlines()
        content = [n for n, line in enumerate(self.lines) if line.partition("#")[0].strip()]
        # The header and the counts stand on one line or on two.
        header = self.lines[content[0]].partition("#")[0].split()
        first, kind = 1 if len(header) > 1 else 2, header[0]
        self._rows = content[first : first + len(self.positions)]
        words = [len(self.lines[n].partition("#")[0].split()) for n in self._rows]
        if len(words) < len(self.positions) or min(words, default=0) < 3:  # not a vertex a line: only the mesh stays
            self._rows, words = [], [3]
        self._colored = "N" not in kind and "4" not in kind and min(words) >= 6
        faces = content[first + len(self.positions) :]
        if len(self.faces) > len(faces):
            self.carries["polygons"] = "polygons"
        if self._colored:
            self._carry("colors")
        elif min(words) > 3:
            self.carries["properties"] = "further numbers of vertices"

    def with_positions(self, positions: FloatArray) -> bytes:
        """The file with other positions."""
        if not self._rows:
            return off_bytes(positions, self.faces)
        lines = list(self.lines)
        for number, (x, y, z) in zip(self._rows, positions.tolist(), strict=True):
            lines[number] = " ".join([repr(x), repr(y), repr(z), *lines[number].split(None, 3)[3:]])
        return ("\n".join(lines) + "\n").encode("utf-8", errors="surrogateescape")

    def parts(self) -> list[Part]:
        """One part."""
        everything = np.arange(len(self.positions))
        if not self._colored:
            return [Part(everything, self.faces, Material())]
        rows = [[float(word) for word in self.lines[n].partition("#")[0].split()[3:7]] for n in self._rows]
        colors = np.array([row[: min(map(len, rows))] for row in rows])
        # Whole numbers go to 255, others to 1.
        whole = all("." not in self.lines[n].partition("#")[0].split()[3] for n in self._rows)
        white = Material(self.path.stem, (1.0, 1.0, 1.0, 1.0))
        return [Part(everything, self.faces, white, colors=linear(colors / (255 if whole else 1)))]
