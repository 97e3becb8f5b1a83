"""Numbers of glTF files, decoded by hand; and the official validator (gltf-validator of npm), where node has it."""

import functools
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pygltflib

_SCRIPT = """
const validator = require("gltf-validator"), fs = require("fs");
if (process.argv[1]) {
  validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])), {maxIssues: 0})
    .then((report) => console.log(JSON.stringify(report.issues)));
}
"""


@functools.cache
def is_there() -> bool:
    """Whether node finds the validator."""
    if shutil.which("node") is None:
        return False
    return subprocess.run(["node", "-e", _SCRIPT], capture_output=True, check=False).returncode == 0


def issues(path: Path) -> list[str]:
    """Errors and warnings; none where the validator is not there, which `is_there` says."""
    if not is_there():
        return []
    done = subprocess.run(["node", "-e", _SCRIPT, str(path)], capture_output=True, text=True, check=True, timeout=120)
    found = json.loads(done.stdout)
    return [f"{m['code']} at {m.get('pointer')}: {m['message']}" for m in found["messages"] if m["severity"] < 2]


COMPONENTS = {5121: "u1", 5123: "<u2", 5125: "<u4", 5122: "<i2", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def accessor(gltf: pygltflib.GLTF2, number: int) -> np.ndarray:
    """The numbers of an accessor, normalised ones as fractions (sections 3.6.2 and 3.11), scalars in one dimension."""
    a = gltf.accessors[number]
    view = gltf.bufferViews[a.bufferView]
    dtype, width = np.dtype(COMPONENTS[a.componentType]), WIDTHS[a.type]
    place = (view.byteOffset or 0) + (a.byteOffset or 0)
    stride = (view.byteStride or dtype.itemsize * width, dtype.itemsize)
    rows = np.ndarray((a.count, width), dtype, gltf.binary_blob(), place, stride)
    if a.min:  # pygltflib reads a missing one as an empty list
        np.testing.assert_array_equal([a.min, a.max], [rows.min(axis=0), rows.max(axis=0)])
    numbers = np.maximum(rows.astype(np.float64) / np.iinfo(dtype).max, -1) if a.normalized else rows.astype(np.float64)
    return numbers[:, 0] if width == 1 else numbers
