"""Training on flat ground against mjlab's, in turns on one device.

``python -m benchmarks.against_mjlab site=FOLDER [num_envs=4096] [rounds=3] [seconds=20] [device=cuda:0]
[own_steps=false]``

go1exp trains ``experiment=paper_flat backend=warp ppo=paper``, mjlab 1.6.0 its task ``Mjlab-Velocity-Flat-Unitree-Go1``
with its own runner (rsl_rl) and settings, except that its physics step is go1exp's, 2 ms, and ten of them make a policy
step as here. ``own_steps=true`` measures it with its own 5 ms x 4 as well. The tasks are not the same: each has its own
rewards, noise, randomisation and contact model; the output lists those that cost time.

FOLDER holds mjlab with its dependencies, which are older than those of go1exp, so each side is a process of its own;
torch may come from there or from the Python that runs this. Neither side has a viewer, a logger or checkpoints;
building, compiling, recording of graphs and the first iterations do not count. The processes work in turns, each for a
round of at least ``seconds``, while the others wait for a line on their standard input. A side that fails is reported
with its last output, and the other is still measured.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import os
import select
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import distributions, version
from pathlib import Path
from typing import IO, Any

NEEDS = {"mjlab": "1.6.0", "rsl-rl-lib": "5.4.2", "mujoco": "3.11", "mujoco-warp": "3.11", "tensordict": ""}
"""What FOLDER must hold -> how its version begins; mjlab's metadata."""

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
PHYSICS_DT, DECIMATION = 0.002, 10
WARM_UP, TRIAL = 12, 4
"""Iterations that do not count (5.8 s of every robot: resets, pushes and new commands happen and compile what they
need), and those after them that tell how many make a round."""

START_S, ANSWER_S = 1500.0, 600.0
"""How long a side may take until it can be measured (kernels are compiled), and over ten times a round's length."""

ENGINE = ("mujoco", "mujoco_warp", "warp", "torch")
"""Modules that both sides use, each in its own versions."""

TAIL = 30
"""Lines of a failed side's output that are shown."""

Loop = Callable[[int], None]
"""Makes that many iterations and waits for the device."""


# What runs in a process of its own. Nothing of go1exp is imported at the top: it is not there for mjlab's.


def go1exp_loop(num_envs: int, device: str) -> tuple[Loop, int, dict[str, str]]:
    """Return go1exp's training, its steps an iteration, and its settings."""
    from go1exp.config.compose import compose
    from go1exp.sim.env.sb3_env import Go1VecEnv
    from go1exp.sim.physics.scene import build_model
    from go1exp.sim.task import parse_train
    from go1exp.train import trainer

    graph = device != "cpu"
    overrides = ["experiment=paper_flat", "backend=warp", "ppo=paper", f"ppo.num_envs={num_envs}"]
    config = parse_train(compose("train", [*overrides, f"backend.device={device}", f"backend.graph={graph}"]))
    ppo = trainer.build(config)
    env = ppo.get_env()
    assert isinstance(env, Go1VecEnv)
    size, sim, p = config.ppo.num_envs * config.ppo.steps, config.task.sim, config.ppo

    def loop(iterations: int) -> None:
        ppo.learn(iterations * size, reset_num_timesteps=ppo.iteration == 0)
        wait(device)

    task = config.task
    model, _ = build_model(task.robot, env.core.terrain, sim.physics_dt, contact=task.contact)
    about = {
        "physics": f"{1000 * sim.physics_dt:g} ms x {sim.decimation}",
        "solver": solver(model),
        "CUDA graphs": "policy step, gradient step" if env.core.captures else "no",
        "observations": f"{env.core.observation_size}",
        "networks": " x ".join(map(str, p.hidden)),
        "update": f"{p.steps} steps, {p.epochs} epochs, {p.minibatches} minibatches",
    }
    return loop, size, described(device, (), ("go1exp", *ENGINE)) | about


def mjlab_loop(num_envs: int, device: str, its_steps: bool) -> tuple[Loop, int, dict[str, str]]:
    """Return mjlab's training, its steps an iteration, and its settings: what its ``train`` script does, unlogged."""
    from dataclasses import asdict

    os.environ["MUJOCO_GL"] = "disable"  # mjlab's default asks for EGL, which only a viewer needs
    envs, rl, registry, backends = (
        importlib.import_module(f"mjlab.{name}") for name in ("envs", "rl", "tasks.registry", "utils.torch")
    )
    importlib.import_module("mjlab.tasks")
    backends.configure_torch_backends()
    config, agent = registry.load_env_cfg(TASK), registry.load_rl_cfg(TASK)
    config.scene.num_envs, config.seed = num_envs, agent.seed
    if not its_steps:
        config.sim.mujoco.timestep, config.decimation = PHYSICS_DT, DECIMATION
    raw = envs.ManagerBasedRlEnv(cfg=config, device=device)
    env = rl.RslRlVecEnvWrapper(raw, clip_actions=agent.clip_actions)
    make = registry.load_runner_cls(TASK) or rl.MjlabOnPolicyRunner
    runner = make(env, asdict(agent), None, device)  # without a folder it logs and saves nothing
    begun = False

    def loop(iterations: int) -> None:
        nonlocal begun
        runner.learn(num_learning_iterations=iterations, init_at_random_ep_len=not begun)
        begun = True
        wait(device)

    sizes = {name: size[0] for name, size in raw.observation_manager.group_obs_dim.items()}
    a = agent.algorithm
    about = {
        "physics": f"{1000 * raw.physics_dt:g} ms x {config.decimation}",
        "solver": solver(raw.sim.mj_model),
        "CUDA graphs": "physics step, forward, reset, sensors" if raw.sim.use_cuda_graph else "no",
        "observations": ", ".join(f"{size} ({name})" for name, size in sizes.items()),
        "networks": " x ".join(map(str, agent.actor.hidden_dims)),
        "update": f"{agent.num_steps_per_env} steps, {a.num_learning_epochs} epochs, {a.num_mini_batches} minibatches",
    }
    return loop, num_envs * agent.num_steps_per_env, described(device, ("mjlab", "rsl-rl-lib"), ENGINE) | about


def solver(model: Any) -> str:
    """Describe what a compiled MuJoCo model asks of the solver."""
    mujoco = importlib.import_module("mujoco")
    o = model.opt
    names = [
        kind(value).name.rsplit("_", 1)[1].lower()
        for kind, value in (
            (mujoco.mjtSolver, o.solver),
            (mujoco.mjtIntegrator, o.integrator),
            (mujoco.mjtCone, o.cone),
        )
    ]
    return (
        f"{', '.join(names)} cone, at most {o.iterations} iterations of {o.ls_iterations} line searches, "
        f"{model.ngeom} shapes, {model.nsensordata} sensor values"
    )


def described(device: str, packages: Sequence[str], modules: Sequence[str]) -> dict[str, str]:
    """Name the device, the versions that matter and what torch does to float32 in matrix products."""
    import torch

    versions = [f"{name} {version(name)}" for name in packages]
    versions += [f"{name} {importlib.import_module(name).__version__}" for name in modules]
    where = torch.cuda.get_device_name(device) if device != "cpu" else "CPU"
    precision = "tf32" if torch.backends.cuda.matmul.fp32_precision == "tf32" else "float32"
    return {"device": where, "versions": ", ".join(versions), "products": precision}


def wait(device: str) -> None:
    """Wait for the device."""
    if device != "cpu":
        import torch

        torch.cuda.synchronize(device)


def serve(make: Callable[[], tuple[Loop, int, dict[str, str]]]) -> None:
    """Build, warm up, then measure a round for every line on standard input: its least length, s."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer

    def answer(**content: Any) -> None:
        print(json.dumps(content), file=answers, flush=True)

    start = time.perf_counter()
    loop, size, about = make()
    loop(WARM_UP)
    answer(about=about, start=time.perf_counter() - start)

    def seconds(iterations: int) -> float:
        start = time.perf_counter()
        loop(iterations)
        return time.perf_counter() - start

    each = 0.0
    for line in sys.stdin:
        each = each or seconds(TRIAL) / TRIAL  # not before: the other side may still have been building
        iterations = max(1, math.ceil(float(line) / each))
        took = seconds(iterations)
        each = took / iterations
        answer(steps=iterations * size, seconds=took)


# What asks them in turns.


class Failed(RuntimeError):
    """A side ended, or did not answer in time."""


@dataclass
class Side:
    """One of those that are compared: its name, how to start it, and what it answered."""

    name: str
    command: Sequence[str]
    python_path: str
    rates: list[float] = field(default_factory=list)
    about: dict[str, str] = field(default_factory=dict)
    start_s: float = math.nan
    failure: str = ""

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Keep its process for as long as the context lasts."""
        environment = {**os.environ, "PYTHONPATH": self.python_path}
        with tempfile.TemporaryFile("w+") as self._errors:
            self._process = subprocess.Popen(
                self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, env=environment
            )
            try:
                yield
            finally:
                self._process.kill()
                self._process.communicate()

    def _answer(self, limit: float) -> dict[str, Any]:
        stdout: IO[bytes] | None = self._process.stdout
        assert stdout is not None
        if not select.select([stdout], [], [], limit)[0]:
            raise Failed(f"no answer within {limit:g} s")
        line = stdout.readline()
        if not line:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(ANSWER_S)
            raise Failed(f"ended with exit status {self._process.poll()}")
        content: dict[str, Any] = json.loads(line)
        return content

    def attempt(self, work: Callable[[], None]) -> None:
        """Do something with it; if it fails, note why and what it wrote last, and do nothing with it any more."""
        if self.failure:
            return
        try:
            work()
        except (Failed, OSError) as error:
            self._process.kill()
            self._process.wait()
            self._errors.seek(0)
            tail = self._errors.read().splitlines()[-TAIL:]
            self.failure = "\n".join([str(error), *(f"    {line}" for line in tail)])

    def wait(self) -> None:
        """Wait until it can be measured."""
        content = self._answer(START_S)
        self.about, self.start_s = content["about"], content["start"]

    def measure(self, seconds: float) -> None:
        """Have it train for a round."""
        stdin = self._process.stdin
        assert stdin is not None
        stdin.write(f"{seconds}\n".encode())
        stdin.flush()
        content = self._answer(ANSWER_S + 10 * seconds)
        self.rates.append(content["steps"] / content["seconds"])


def compare(sides: Sequence[Side], rounds: int, seconds: float) -> None:
    """Measure all in turns; what they answered and how they failed is in them afterwards."""
    with contextlib.ExitStack() as stack:
        for side in sides:
            stack.enter_context(side.running())
        for side in sides:
            side.attempt(side.wait)
            if not side.failure:
                print(f"{side.name}: {side.start_s:.0f} s to build, compile and warm up", flush=True)
        for k in range(rounds):
            for side in sides:
                side.attempt(partial(side.measure, seconds))
            latest = (f"{side.name} {side.rates[k]:,.0f}" for side in sides if len(side.rates) > k)
            print(f"round {k + 1} of {rounds}, steps/s:", ", ".join(latest), flush=True)


def report(sides: Sequence[Side]) -> str:
    """Return the table: rates, their spread, the first side's over each other's, settings, failures."""
    width = max(len(side.name) for side in sides)
    lines = [f"{'':{width}}  steps/s, median     least      most  {sides[0].name} over it (least to most)"]
    for side in sides:
        if not side.rates:
            continue
        over = [a / b for a, b in zip(sides[0].rates, side.rates, strict=False)]
        ratio = (
            f"{statistics.median(over):.2f} ({min(over):.2f} to {max(over):.2f})"
            if over and side is not sides[0]
            else ""
        )
        figures = f"{statistics.median(side.rates):15,.0f}{min(side.rates):10,.0f}{max(side.rates):10,.0f}"
        lines.append(f"{side.name:{width}}  {figures}  {ratio}".rstrip())
    for side in sides:
        lines += ["", f"{side.name}:", *(f"  {key}: {value}" for key, value in side.about.items())]
        if side.failure:
            lines.append(f"  FAILED after {len(side.rates)} rounds: {side.failure}")
    return "\n".join(lines)


def missing_packages(folder: Path) -> list[str]:
    """Return the dependencies of mjlab that are not in a folder, one line each."""
    installed = {d.metadata["Name"].lower().replace("_", "-"): d.version for d in distributions(path=[str(folder)])}
    return [
        f"{name} {wanted}".strip() + (f" (there is {installed[name]})" if name in installed else "")
        for name, wanted in NEEDS.items()
        if name not in installed or not installed[name].startswith(wanted)
    ]


def pins() -> list[str]:
    """Return pip's requirements for the installed versions of torch and warp."""
    installed = {d.metadata["Name"]: d.version.partition("+")[0] for d in distributions()}
    return [f"{name}=={installed[name]}" for name in ("torch", "warp-lang") if name in installed]


def main(arguments: Sequence[str]) -> int:
    """Compare, print, and return the exit status: 1 if a side failed."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    known = {"site", "num_envs", "rounds", "seconds", "device", "own_steps", "worker"}
    if not {"site"} <= set(given) <= known or len(given) != len(arguments):
        raise SystemExit(
            "usage: python -m benchmarks.against_mjlab site=FOLDER [num_envs=4096] [rounds=3] [seconds=20] "
            "[device=cuda:0] [own_steps=false]"
        )
    device, its_steps_setting = given.get("device", "cuda:0"), given.get("own_steps", "false")
    try:
        num_envs, rounds = int(given.get("num_envs", 4096)), int(given.get("rounds", 3))
        seconds = float(given.get("seconds", 20))
    except ValueError as error:
        raise SystemExit(f"num_envs and rounds must be whole numbers and seconds a number: {error}") from error
    if its_steps_setting not in ("true", "false"):
        raise SystemExit(f"own_steps={its_steps_setting}: true or false")
    if "worker" in given:
        if given["worker"] == "go1exp":
            serve(lambda: go1exp_loop(num_envs, device))
        else:
            serve(lambda: mjlab_loop(num_envs, device, its_steps_setting == "true"))
        return 0
    folder = Path(given["site"]).expanduser().resolve()
    if missing := missing_packages(folder):
        raise SystemExit(
            f"site={folder}: misses {', '.join(missing)}. To make it, with the torch and warp that are here:\n"
            f"  {sys.executable} -m pip install --target FOLDER mjlab=={NEEDS['mjlab']} {' '.join(pins())}"
        )

    def worker(which: str, its_steps: str) -> list[str]:
        settings = [f"worker={which}", "site=", f"num_envs={num_envs}", f"device={device}", f"own_steps={its_steps}"]
        return [sys.executable, "-P", __file__, *settings]

    path = os.pathsep.join(p for p in (str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH")) if p)
    sides = [Side("go1exp", worker("go1exp", "false"), path), Side("mjlab", worker("mjlab", "false"), str(folder))]
    if its_steps_setting == "true":
        sides.append(Side("mjlab 5 ms x 4", worker("mjlab", "true"), str(folder)))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # not without ending the sides
    try:
        compare(sides, rounds, seconds)
    finally:  # of what there is, if somebody ends it
        print(
            f"\n{num_envs} environments, {rounds} rounds of {seconds:g} s each, in turns\n\n{report(sides)}", flush=True
        )
    return 1 if any(side.failure for side in sides) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
