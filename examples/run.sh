#!/bin/sh
# The main job on the sample key-frames:  sh examples/run.sh [arguments for torch-modal demo]
# Sets everything up first where needed. Results go to out/demo in the repository, and replace those of an earlier run.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
. "$root/tests/environment.sh"

case " $* " in
*" --out "* | *" --out="*) exec "$python" -m torch_modal demo "$@" ;;
*) exec "$python" -m torch_modal demo --out "$root/out/demo" --overwrite "$@" ;;
esac
