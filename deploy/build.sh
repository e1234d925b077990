#!/bin/sh
# Builds go1exp's wheel, with the Kalman filter compiled in, into FOLDER. Needs a C++ compiler and Python 3.11 with pip.
# The tools come from requirements/build.txt into an environment that is thrown away.
#
# usage: [PYTHON=python3.11] deploy/build.sh FOLDER
set -eu

[ $# -eq 1 ] || { echo "usage: [PYTHON=python3.11] deploy/build.sh FOLDER" >&2; exit 2; }
python=${PYTHON:-python3}
mkdir -p "$1"
out=$(cd "$1" && pwd)
cd "$(dirname "$0")/.."

tools=$(mktemp -d)
trap 'rm -rf "$tools"' EXIT
pip() {
  "$python" -m pip --python "$tools/bin/python" --disable-pip-version-check --no-input "$@"
}

"$python" -m venv --without-pip "$tools"
pip install -qq --require-hashes --no-deps --only-binary=:all: -r requirements/build.txt
pip wheel -qq --no-build-isolation --no-deps -w "$out" .

# Without a compiler hatch_build.py packs a wheel without the filter, tagged for every machine.
for wheel in "$out"/go1exp-*.whl; do
  case $wheel in
    *-none-any.whl) echo "deploy/build.sh: $wheel has no Kalman filter: no C++ compiler or no Python.h?" >&2; exit 1 ;;
  esac
  echo "$wheel"
done
