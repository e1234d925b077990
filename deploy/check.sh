#!/bin/sh
# Holds that FOLDER (deploy/install.sh) has what the robot's computer needs and nothing more: the packages of its
# requirements.txt in these versions and go1exp, all that the runtime imports, the compiled filter; no torch, no
# simulator. Says its size. With a BUNDLE, also loads it, which replays its trace.
#
# usage: deploy/check.sh FOLDER [BUNDLE]
set -eu

case $# in
  1 | 2) ;;
  *) echo "usage: deploy/check.sh FOLDER [BUNDLE]" >&2; exit 2 ;;
esac
[ -x "$1/bin/python" ] || { echo "deploy/check.sh: $1 is no virtual environment" >&2; exit 1; }

# -I: neither the working folder nor PYTHONPATH lends what is missing.
exec "$1/bin/python" -I - "$@" <<'PYTHON'
import importlib
import importlib.metadata
import importlib.util
import re
import sys
from pathlib import Path

HEAVY = ("torch", "stable_baselines3", "gymnasium", "mujoco", "hydra", "omegaconf", "scipy", "onnx", "matplotlib", "pip")
folder, bundle = Path(sys.argv[1]), sys.argv[2:]


def refuse(why):
    sys.exit(f"deploy/check.sh: {folder}: {why}")


def plain(name):
    return re.sub(r"[-_.]+", "-", name).lower()


if there := [name for name in HEAVY if importlib.util.find_spec(name)]:
    refuse(f"{', '.join(there)} must not be in it")

pins = re.findall(r"^([\w.-]+)==(\S+)", (folder / "requirements.txt").read_text(), re.MULTILINE)
wanted = {plain(name): version for name, version in pins}
found = {plain(d.metadata["Name"]): d.version for d in importlib.metadata.distributions()}
if "go1exp" not in found:
    refuse("go1exp itself is missing: deploy/install.sh FOLDER WHEEL")
version = found.pop("go1exp")
if found != wanted:
    refuse("not what its requirements.txt names: " + ", ".join(sorted({n for n, _ in found.items() ^ wanted.items()})))

import go1exp

runtime = Path(go1exp.__path__[0], "deploy", "runtime").glob("[!_]*.py")
for name in ("pyarrow.parquet", "go1exp.logs.recording", *(f"go1exp.deploy.runtime.{file.stem}" for file in runtime)):
    importlib.import_module(name)

from go1exp.deploy.estimation import compiled, go1, make_filter

compiled()
make_filter(go1())
print(f"go1exp {version} for Python {sys.version.split()[0]}, filter compiled; {len(found)} packages beside it")


def size(path):
    files = [path] if path.is_file() else [file for file in path.rglob("*") if not file.is_dir()]
    return sum(file.lstat().st_size for file in files) / 1e6


parts = {}
for path in Path(go1exp.__path__[0]).parent.iterdir():
    name = path.name.removesuffix(".libs")
    parts[name] = parts.get(name, 0.0) + size(path)
largest = sorted(parts, key=parts.get, reverse=True)[:4]
print(f"size: {size(folder):.0f} MB; " + ", ".join(f"{name} {parts[name]:.0f}" for name in largest))

if bundle:
    from go1exp.deploy.runtime.bundle import load
    from go1exp.base.errors import Expected

    try:
        loaded = load(bundle[0])
    except (Expected, OSError) as error:
        refuse(error)
    print(f"bundle: {loaded.source}, SHA-256 {loaded.seal}")
PYTHON
