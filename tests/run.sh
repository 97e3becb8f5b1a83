#!/bin/sh
# Lint, types, tests:  sh tests/run.sh [arguments for pytest, with paths from the repository's root]
# Sets everything up first where needed. Tests marked slow run if CI=true, or with -m "" (all) or -m slow. Several
# processes share the work, a file of tests each, in the order of the folders: by the number of tests, long files of few
# tests would come last. -n 0 is one process, for a debugger.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
. "$root/tests/environment.sh"
cd "$root"

"$python" -m ruff check .
"$python" -m ruff format --check .
# Types are those of the pinned NumPy, which has no release for Python 3.10 (mypy assumes that language version anyway).
if "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then "$python" -m mypy; fi
# A later -m wins over this one.
[ "${CI:-}" = true ] || set -- -m "not slow" "$@"
exec "$python" -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder "$@"
