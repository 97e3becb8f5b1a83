#!/bin/sh
# The documentation as a site, in out/docs:  sh docs/build.sh [arguments for sphinx-build]
# With --version as the first argument in out/docs/VERSION, next to the versions that were built before, and a page that
# lists them all in out/docs/index.html.
# Sets everything up first where needed. Warnings are errors.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
. "$root/tests/environment.sh"
cd "$root"

folder=
if [ "${1:-}" = --version ]; then
    shift
    folder=/$("$python" -c 'import torch_modal; print(torch_modal.__version__)')
fi
"$python" -m sphinx --fail-on-warning --keep-going --builder html "$@" docs "out/docs$folder"
if [ -n "$folder" ]; then
    {
        printf '%s\n' '<!doctype html><html lang="en"><meta charset="utf-8"><title>torch_modal</title>' '<h1>torch_modal</h1><ul>'
        for page in out/docs/*/objects.inv; do basename "$(dirname "$page")"; done | sort -rV |
            while read -r version; do printf '%s\n' "<li><a href=\"$version/index.html\">$version</a></li>"; done
        printf '%s\n' '</ul></html>'
    } >out/docs/.index.html
    mv out/docs/.index.html out/docs/index.html
fi
