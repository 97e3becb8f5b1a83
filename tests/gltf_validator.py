"""The official glTF validator (gltf-validator of npm), where node and the package are (NODE_PATH names its folder)."""

import functools
import json
import shutil
import subprocess
from pathlib import Path

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
