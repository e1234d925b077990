"""The robot's computer: what deploy/Dockerfile does, done without Docker, and a walk in what comes of it."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from deploy.lock import FOLDER, PARTS, blocks, part
from go1exp.base.paths import data_root
from go1exp.deploy.export.build import build
from go1exp.deploy.runtime.launch import SimulatedRobot
from go1exp.deploy.runtime.walk import STATUS
from go1exp.logs import recording

ROOT = data_root()
SCRIPTS = {"build.sh", "check.sh", "install.sh"}

CLEAN = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
"""What is left of the environment: nothing may lead from the runtime to this checkout."""

Lines = list[tuple[str, str]]


def dockerfile() -> Lines:
    """The instructions of deploy/Dockerfile with their arguments."""
    text = (ROOT / "deploy/Dockerfile").read_text().replace("\\\n", " ")
    lines = [line.strip() for line in text.splitlines()]
    return [(word, rest.strip()) for word, _, rest in (s.partition(" ") for s in lines if s and s[0] != "#")]


def all_of(word: str) -> list[str]:
    return [rest for name, rest in dockerfile() if name == word]


# ---------------------------------------------------------------------- what is written


def test_every_installing_line_is_a_script_of_deploy() -> None:
    assert {file.name for file in (ROOT / "deploy").glob("*.sh")} == SCRIPTS
    for name in SCRIPTS:
        assert os.access(ROOT / "deploy" / name, os.X_OK), name
        subprocess.run(["sh", "-n", ROOT / "deploy" / name], check=True)
    words = {word for word, _ in dockerfile()}
    assert words <= {*("ARG", "FROM", "WORKDIR", "COPY", "RUN"), *("ENV", "USER", "STOPSIGNAL", "ENTRYPOINT", "CMD")}
    runs = [shlex.split(run) for run in all_of("RUN")]
    assert {Path(run[0]).name for run in runs} == SCRIPTS
    for run in runs:
        assert run[0] in {*(f"deploy/{name}" for name in SCRIPTS), "/opt/go1exp/bin/check.sh"}
        assert all(re.fullmatch(r"[\w./*-]+", word) for word in run), run  # one command, no second one behind it


def test_the_image_is_pinned_and_its_process_is_the_runtime_of_a_plain_user() -> None:
    given = dict(line.split("=") for line in all_of("ARG") if "=" in line)
    froms = [re.sub(r"\$\{(\w+)\}", lambda name: given[name[1]], line).split()[0] for line in all_of("FROM")]
    version = given["PYTHON_TAG"]
    assert froms == [f"python:{version}-bookworm", f"python:{version}-slim-bookworm"]
    assert re.fullmatch(r"3\.11\.\d+", version)
    assert all_of("USER") == ["1000:1000"]
    assert all_of("STOPSIGNAL") == ["SIGTERM"]
    (entry,) = all_of("ENTRYPOINT")
    assert json.loads(entry) == ["/opt/go1exp/bin/python", "-m", "go1exp.deploy"]


def test_all_that_is_copied_is_sent_to_docker_and_nothing_else() -> None:
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    sent = {line[1:] for line in lines if line.startswith("!")}
    sources = {s for line in all_of("COPY") if "--from" not in line for s in line.split()[:-1]}
    assert {Path(source).parts[0] for source in sources} == sent
    assert all((ROOT / source).exists() for source in sources)
    assert lines[1] == "*"


def test_the_parts_of_the_lock_are_the_locks() -> None:
    lock = (FOLDER / "lock.txt").read_text()
    whole = blocks(lock)
    assert "".join(whole.values()) == lock[lock.index("absl-py") :]
    for file, wanted in PARTS.items():
        text = (FOLDER / file).read_text()
        assert text == part(lock, wanted), f"make lock writes {file} anew"
        assert "://" not in text
        chosen = blocks(text)
        assert chosen.items() <= whole.items()
        # The comments in the lock are not the only ones who know who needs whom.
        needs: set[str] = {canonicalize_name(name) for name in wanted}
        while more := {n for name in needs for n in needed(name)} - needs:
            needs |= more
        assert set(chosen) == needs
    assert "torch" not in (FOLDER / "deploy.txt").read_text()
    with (ROOT / "pyproject.toml").open("rb") as opened:
        system = tomllib.load(opened)["build-system"]["requires"]
    assert {Requirement(line).name for line in system} == set(PARTS["build.txt"])


def needed(package: str) -> set[str]:
    """What an installed package asks for on this machine."""
    lines = map(Requirement, importlib.metadata.requires(package) or [])
    return {canonicalize_name(r.name) for r in lines if r.marker is None or r.marker.evaluate({"extra": ""})}


# ---------------------------------------------------------------------- what it makes


def copy(words: list[str], folder: Path, root: Path) -> None:
    *sources, place = words
    target = root / place.lstrip("/") if place.startswith("/") else folder / place
    for source in sources:
        if (ROOT / source).is_dir():
            left = shutil.ignore_patterns("__pycache__", "*.so")
            shutil.copytree(ROOT / source, target, ignore=left, dirs_exist_ok=True)
        else:
            into = target / Path(source).name if place.endswith("/") else target
            into.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / source, into)


def replay(root: Path) -> str:
    """Follow the Dockerfile with ``root`` for its /; return what the last RUN said."""
    folder, said = root, ""
    for word, rest in dockerfile():
        words = rest.split()
        if word == "FROM":
            folder = root
        elif word == "WORKDIR":
            folder = root / rest.lstrip("/")
            folder.mkdir()
        elif word == "COPY" and words[0].startswith("--from="):
            # Of the stage before, only this is left, and where it was.
            assert words[1:] == ["/opt/go1exp", "/opt/go1exp"]
            for other in root.iterdir():
                if other.name != "opt":
                    shutil.rmtree(other)
        elif word == "COPY":
            copy(words, folder, root)
        elif word == "RUN":
            command = " ".join(f"{root}{w}" if w.startswith("/") else w for w in words)
            done = subprocess.run(
                *(command,),
                shell=True,
                cwd=folder,
                env={**CLEAN, "PYTHON": sys.executable},
                capture_output=True,
                text=True,
            )
            assert done.returncode == 0, f"{rest}\n{done.stdout}{done.stderr}"
            said = done.stdout
    return said


@pytest.mark.slow("deploy/", "go1exp/deploy/", "go1exp/deploy/estimation/", "hatch_build.py", ".dockerignore")
def test_the_lines_of_the_dockerfile_make_a_runtime_that_walks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "image"
    root.mkdir()
    said = replay(root)
    assert re.search(r"^go1exp \S+ for Python 3\.\d+\.\d+, filter compiled; 11 packages beside it$", said, re.MULTILINE)
    (size,) = re.findall(r"^size: (\d+) MB; pyarrow \d+", said, re.MULTILINE)
    assert 100 < int(size) < 400
    venv = root / "opt/go1exp"
    packages = {file.name for file in (venv / "lib").glob("python3*/site-packages/*")}
    assert {"go1exp", "numpy", "onnxruntime"} <= packages
    assert packages.isdisjoint(
        {"torch", "stable_baselines3", "gymnasium", "mujoco", "hydra", "omegaconf", "scipy", "pip"}
    )
    assert not (venv / "bin/go1exp").exists()

    # The check refuses what does not belong there, and what is missing.
    check = [str(venv / "bin/check.sh"), str(venv)]
    foreign = next((venv / "lib").glob("python3*/site-packages")) / "mujoco.py"
    foreign.touch()
    done = subprocess.run(check, env=CLEAN, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (1, f"deploy/check.sh: {venv}: mujoco must not be in it\n")
    foreign.unlink()
    pins = venv / "requirements.txt"
    before = pins.read_text()
    pins.write_text(before.replace("numpy==", "numpy==1"))
    done = subprocess.run(check, env=CLEAN, capture_output=True, text=True)
    assert (done.returncode, done.stderr[-6:]) == (1, "numpy\n")
    pins.write_text(before)

    bundle = tmp_path / "walk.zip"
    bundle.write_bytes(build(ROOT / "assets/policies/paper", seconds=0.5))
    done = subprocess.run([*check, str(bundle)], env=CLEAN, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"bundle: {bundle}, SHA-256 " in done.stdout

    entry = [f"{root}{w}" if w.startswith("/") else w for w in json.loads(all_of("ENTRYPOINT")[0])]
    logs, home = root / "logs", root / "home"
    home.mkdir()
    bare = {"PATH": os.environ["PATH"], "HOME": str(home)}  # no CI variable either: they change what libraries do
    done = subprocess.run([*entry, *json.loads(all_of("CMD")[0])], cwd=logs, env=bare, capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout.startswith("usage: python -m go1exp.deploy")

    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # of the robots' processes alone
    words = [*entry, str(bundle), "--command", "0.5,0,0", "--stand-up", "0.5", "--lie-down", "0"]
    words += ["--brake", "0.2", "--stale", "5"]
    with SimulatedRobot(str(bundle), {"noise": 0.1}, {}) as robot:
        done = subprocess.run(
            [*words, "--robot", str(robot.port), "--seconds", "2"], cwd=logs, env=bare, capture_output=True, text=True
        )
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    assert done.stdout.splitlines()[-1] == "walked for 2.0 s, to the end"
    (file,) = (logs / "runs/deploy").glob("*.parquet")
    account = json.loads(file.with_suffix(".json").read_text())
    assert (account["ended"], account["status"]) == ("walked to the end", 0)
    # By the real clock: the first cycle within half a period of 2 s ends it, or a later one if that is missed.
    assert 2.0 - 0.5 / 50 < account["walked_s"] < 2.0 + (account["timing"]["missed"] + 1) / 50
    found = recording.read(file)
    assert (found.meta.tool, found.meta.source, found.meta.excitation) == ("go1exp deploy", "simulated", "policy")
    # By the robot's clock, which loses what its process cannot make up for; rows of standing up have other gains.
    lasted = account["walked_s"]
    assert lasted - robot.report["slipped"] - 0.1 < found.t[-1] - found.t[0] < lasted + 0.1
    assert np.ptp(found.joint("q"), axis=0).max() > 0.2  # its legs went
    assert robot.report["commands"] > 100

    # `docker stop`: SIGTERM, and the drives brake.
    with SimulatedRobot(str(bundle), {"noise": 0.1}, {}) as robot:
        process = subprocess.Popen(
            *([*words, "--robot", str(robot.port)],), cwd=logs, env=bare, stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("walking: "):
                process.send_signal(signal.SIGTERM)
                break
        rest, _ = process.communicate(timeout=30)
    assert process.returncode == STATUS["operator_stop"]
    assert rest.splitlines()[-1].endswith("requested by SIGTERM")
    assert len(list((logs / "runs/deploy").glob("*.parquet"))) == 2
    assert list(home.iterdir()) == []  # onnxruntime would keep an identifier for its reports there
