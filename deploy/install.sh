#!/bin/sh
# Makes FOLDER a virtual environment that runs `python -m go1exp.deploy`: the packages of requirements/deploy.txt and,
# if it is given, go1exp's wheel (deploy/build.sh). No torch, no MuJoCo, no pip in it. Needs Python 3.11 with pip.
#
# usage: [PYTHON=python3.11] deploy/install.sh FOLDER [WHEEL]
set -eu

case $# in
  1 | 2) ;;
  *) echo "usage: [PYTHON=python3.11] deploy/install.sh FOLDER [WHEEL]" >&2; exit 2 ;;
esac
python=${PYTHON:-python3}
lock=$(dirname "$0")/../requirements/deploy.txt
pip() {
  "$python" -m pip --python "$venv/bin/python" --disable-pip-version-check --no-input "$@"
}

[ -x "$1/bin/python" ] || "$python" -m venv --without-pip "$1"
venv=$(cd "$1" && pwd)
pip install -qq --require-hashes --no-deps --only-binary=:all: -r "$lock"
cp "$lock" "$venv/requirements.txt" # what deploy/check.sh holds the environment against
# --no-deps: the wheel asks for all that training needs, torch first. What the runtime needs is there already.
if [ $# -eq 2 ]; then
  pip install -qq --no-deps --force-reinstall "$2"
  rm "$venv/bin/go1exp" # the verbs of the command need what is not here; the runtime is python -m go1exp.deploy
fi
