# Read by examples/run.sh and tests/run.sh, not run by itself: makes .venv in the repository, with torch_modal and
# all that it needs in the versions of constraints.txt. Expects $root, gives $python. Does nothing where all is there.

fail() {
    printf '%s\n' "error: $1" >&2
    exit 1
}

is_recent() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1
}

python=$root/.venv/bin/python

if [ ! -e "$root/.venv" ]; then
    found=
    for candidate in ${PYTHON:+"$PYTHON"} python3 python3.14 python3.13 python3.12 python3.11 python3.10 python; do
        if is_recent "$candidate"; then
            found=$candidate
            break
        fi
    done
    if [ -z "$found" ]; then
        there=$(python3 --version 2>/dev/null || python --version 2>/dev/null || echo "no Python at all")
        fail "Python 3.10 or newer is needed, found: $there. Install one, or name it: PYTHON=/path/to/python3 sh $0"
    fi
    printf '%s\n' "Making the virtual environment $root/.venv with $("$found" --version) ..."
    if ! "$found" -m venv "$root/.venv"; then
        rm -rf "$root/.venv"
        fail "$found cannot make a virtual environment. On Debian and Ubuntu: sudo apt install python3-venv"
    fi
fi
is_recent "$python" || fail "$root/.venv has no working Python of 3.10 or newer. Remove that folder and run this again."

# What is installed depends on these files, and an editable installation on where they lie.
wanted=$("$python" -c '
import hashlib, pathlib, sys
root = pathlib.Path(sys.argv[1])
names = ("setup.py", "pyproject.toml", "constraints.txt")
print(hashlib.sha256(b"\0".join([str(root).encode()] + [(root / name).read_bytes() for name in names])).hexdigest())
' "$root") || fail "setup.py, pyproject.toml or constraints.txt cannot be read in $root"

stamp=$root/.venv/torch_modal-installed
if [ "$(cat "$stamp" 2>/dev/null)" != "$wanted" ]; then
    printf '%s\n' "Installing torch_modal and what it needs into $root/.venv"
    printf '%s\n' "(once; PyTorch is large: 1 to 10 minutes, depending on the network) ..."
    started=$(date +%s)
    # Without a terminal nobody watches the progress, and a log of hundreds of lines hides what matters.
    if [ -t 1 ]; then quiet=; else quiet=--quiet; fi
    (cd "$root" && "$python" -m pip install $quiet --disable-pip-version-check -c constraints.txt -e ".[test]") ||
        fail "the installation failed; pip says above why. Run this again to go on where it stopped."
    printf '%s\n' "$wanted" >"$stamp"
    printf '%s\n' "Installed in $(($(date +%s) - started)) s."
fi
