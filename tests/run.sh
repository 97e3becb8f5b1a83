#!/bin/sh
# Lint, types, tests:  sh tests/run.sh [arguments for pytest, with paths from the repository's root]
# Sets everything up first where needed. Tests marked slow run if CI=true, or with -m "" (all) or -m slow.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
. "$root/tests/environment.sh"
cd "$root"

# Small problems in many processes (the mesher is one more): threads of OpenMP and BLAS then wait for each other.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}" OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-1}"

"$python" -m ruff check .
"$python" -m ruff format --check .
"$python" -m mypy
# A later -m wins over this one.
[ "${CI:-}" = true ] || set -- -m "not slow" "$@"
exec "$python" -m pytest "$@"
