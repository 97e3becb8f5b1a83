#!/bin/sh
# The main job on the sample key-frames:  sh examples/run.sh [arguments for torch-modal demo]
# Sets everything up first where needed. Results go to out/demo in the repository, and replace those of an earlier run.
set -eu

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
. "$root/tests/environment.sh"

# Many small operations: threads would mostly wait for each other, the more the busier the machine is.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"

case " $* " in
*" --out "* | *" --out="*) exec "$python" -m torch_modal demo "$@" ;;
*) exec "$python" -m torch_modal demo --out "$root/out/demo" --overwrite "$@" ;;
esac
