#!/bin/sh
# The documentation as a site, in out/docs:  sh docs/build.sh [arguments for sphinx-build]
# Sets everything up first where needed. Warnings are errors.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
. "$root/tests/environment.sh"
cd "$root"

exec "$python" -m sphinx --fail-on-warning --keep-going --builder html "$@" docs out/docs
