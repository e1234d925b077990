"""README's commands as they are written, one after the other in one folder, with small budgets added at their ends."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from go1exp.base.paths import data_root
from go1exp.cli import SUBVERBS
from tests.command import run

README = (data_root() / "README.md").read_text()

TRAINING = ("ppo.num_envs=4", "ppo.steps=4", "ppo.minibatches=2", "ppo.epochs=1", "ppo.iterations=1")
ONE_CORE = ("backend.threads=1", "torch_threads=1", "logger.tensorboard=false")
NET = ("ppo.hidden=[16,8]",)
JUDGED = ("grid.x=[0.5]", "grid.y=[]", "grid.yaw=[]", "episodes=1", "duration_s=0.4", "settle_s=0.1")
SEARCH = (
    *("search.window_s=0.1", "search.burn_s=0.02", "search.stride_s=0.15", "search.physics_dt=0.002"),
    *("search.max_terms=1", "search.shortlist=1", "search.iterations=1", "search.bootstraps=0", "search.overlays=1"),
    *("search.threads=1", "+search.effects=[coulomb,viscous]"),
)

BUDGETS: dict[str, tuple[str, ...]] = {
    "train resume=": ("ppo.iterations=2", "torch_threads=1"),
    "train start_from=": (*TRAINING, *ONE_CORE),
    "train": (*TRAINING, *ONE_CORE, *NET),
    "eval": JUDGED,
    "play": ("seconds=0.2", "fps=5", "viewer=clip"),
    "bench": ("num_envs=4", "rounds=1", "seconds=0.1", "threads=1"),
    # A robot with friction that the model lacks, so that there is something to find.
    "record import": ("out=theirs",),
    "record audit": (),
    "record": (
        *("excitation=[chirp]", "seeds=[0,1,2,3]", "seconds=0.7", "physics_dt=0.002", "backend.threads=1"),
        *("effect=coulomb", "effect.coulomb.bound=0.5"),
    ),
    "fit-actuator": ("hidden=[6,5,4]", "epochs=2", "epoch_rows=400", "plots=false"),
    "gap replay": ("search.threads=1", "out=replay"),
    "gap": SEARCH,
    "report": ("points=20",),
    "list": (),
    "export check": (),
    "export": ("seconds=0.1",),
    "deploy": ("seconds=1.0", "stand_up=0.5", "brake=0.2", "stale=5"),
}
"""First words of a command -> what is added to it; the first that fits counts."""

LEFT_OUT = {
    "go1exp deploy runs/NAME/bundle.zip command=keyboard": "keys need a terminal: tests/test_deploy.py",
    "go1exp eval policy=paper protocol=paper": "takes eight minutes: tests/test_protocols.py plays each one",
    "go1exp compare paper mpc trot@physx protocol=kicks": "needs an extra: tests/test_protocol_commands.py",
    "go1exp play policy=paper viewer=web": "goes on until Ctrl-C: tests/test_viewer_browser.py",
    "go1exp train -m study=ablations_cpu hydra/launcher=joblib": "takes an hour: tests/test_study.py has a smaller one",
    "go1exp train -m study=ablations_cpu hydra/launcher=slurm": "needs a cluster: tests/test_study.py starts one",
    "go1exp train sweep=runs/SWEEP": "needs a sweep that was stopped: tests/test_study.py, tests/test_sweeps.py",
    "go1exp sim": "goes on until Ctrl-C: tests/test_go1_walk.py",
    "go1exp deploy robot=go1 check=true": "needs a robot: tests/test_go1_walk.py lets it look at a simulated one",
    "go1exp gap next logs=recordings out=gap": "takes minutes: tests/test_gap_next.py has smaller ones",
    "go1exp gap view out=gap": "goes on until Ctrl-C: tests/test_viewer.py, and the page itself as of play",
    "go1exp gap logs=recordings model=go2 out=gap": "needs recordings of a Go2: tests/test_gap_machines.py",
}
"""Commands that are not run, and why."""

STATUSES = {"record audit": (0, 3, 4), "gap logs=": (10, 15)}
"""First words of a command -> exit statuses that are answers; 0 for all others."""


@dataclass(frozen=True)
class Command:
    """A line of README."""

    line: str
    words: tuple[str, ...]
    """Without ``go1exp``."""

    @property
    def budget(self) -> tuple[str, ...]:
        """What is added."""
        return next(more for first, more in BUDGETS.items() if self._begins(first))

    @property
    def statuses(self) -> tuple[int, ...]:
        """Exit statuses that are right."""
        return next((good for first, good in STATUSES.items() if self._begins(first)), (0,))

    def _begins(self, first: str) -> bool:
        said = " ".join(self.words)
        return said.startswith(first) if first.endswith("=") else f"{said} ".startswith(f"{first} ")


def commands() -> list[Command]:
    """The commands in README's blocks without a language, from top to bottom."""
    blocks = re.findall(r"^```\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines() if re.match(r"go1exp [\w-]+ ", line)]
    parts = [(line, tuple(shlex.split(line, comments=True)[1:])) for line in lines]
    return [Command(shlex.join(["go1exp", *words]).replace("'", ""), words) for _, words in parts]


RUN = [command for command in commands() if command.line not in LEFT_OUT]


def test_every_command_of_the_readme_is_run_or_left_out_for_a_reason() -> None:
    assert len(RUN) > 20
    assert set(LEFT_OUT) <= {command.line for command in commands()}
    for first in (*BUDGETS, *STATUSES):
        assert any(command._begins(first) for command in RUN), first
    assert {command.words[0] for command in RUN} <= {words.split()[0] for words in BUDGETS}
    both = {f"{verb} {word}" for verb, words in SUBVERBS.items() for word in words}
    assert both == {"record import", "record audit", "export check", "gap next", "gap loop"}


def test_the_complaint_of_the_readme_is_what_is_printed(tmp_path: Path) -> None:
    ((line, said),) = re.findall(r"^\$ go1exp (.*)\n(.*?) \.\.\.$", README, re.MULTILINE)
    done = run(tmp_path, *shlex.split(line))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(said)


def lay_log(folder: Path) -> None:
    """The log that ``record import`` is shown with: nine rows of a Go2."""
    columns = [f"{quantity}{joint}{end}" for joint in range(12) for quantity, end in (("jpos", ""), ("jvel", ""))]
    columns += [f"jpos{joint}_des" for joint in range(12)]
    rows = np.column_stack([np.tile([20.0, 0.5], (9, 1)), np.full((9, 36), 0.1)])
    (folder / "logs").mkdir()
    header = ",".join(["kp", "kd", *columns])
    np.savetxt(folder / "logs/run.csv", rows, delimiter=",", header=header, comments="")


@pytest.mark.slow("README.md", "conf/", "go1exp/")
def test_the_commands_of_the_readme_work_one_after_the_other(tmp_path: Path) -> None:
    lay_log(tmp_path)
    name = tmp_path / "runs/NAME"
    for command in RUN:
        done = run(tmp_path, *command.words, *command.budget, timeout=600.0)
        assert done.returncode in command.statuses, f"{command.line}\n{done.stdout}{done.stderr}"
        assert "Traceback" not in done.stderr, command.line
        if command.words[0] == "train" and not name.exists():  # the first run is the one that is shown to go on
            (first,) = (folder for folder in (tmp_path / "runs").iterdir() if (folder / "config.yaml").is_file())
            name.symlink_to(first.name)
    for made in ("recordings", "nets/mine/net.npz", "gap/effect.yaml", "runs/NAME/bundle.zip", "runs/quiet", "replay"):
        assert (tmp_path / made).exists(), made
