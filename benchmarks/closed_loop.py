"""The loop closed on a policy: hidden robots are recorded, the gap is named, the policy is fine-tuned and walks again.

    python -m benchmarks.closed_loop out=DIR [size=full|small|tiny] [robots=friction,late] [trainings=1] [seed=0]
        [jobs=1] [threads=2]

For each hidden robot (``benchmarks/gap/hidden.py``, physics that is not the library's) ``go1exp gap`` writes an
``effect.yaml`` from its recordings, suspended, or standing where those give no effect. Then the policy is fine-tuned
with it, and with equally many steps on the plain model and with an actuator net fitted to suspended recordings.
All four policies walk on the hidden robot with the same seeds. Each of the three is trained ``trainings`` times, with
seeds of their own: a training alone says little. Writes ``robots.json``, ``robots.csv`` and
``closed_loop.json``. What is done already is not done again, so an interrupted run goes on. ``jobs`` robots are worked
on at a time: the searches want processor cores, the trainings share the GPU.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import commands
from benchmarks.closed_loop_figures import Walks, figures_of, row_of, table, write_table
from benchmarks.closed_loop_sizes import SIZES, Size
from benchmarks.gap import hidden, logger
from benchmarks.gap.walking import Policy
from benchmarks.results import write_results
from go1exp.deploy.export.graph import DeployedPolicy
from go1exp.sim.task import parse_train
from go1exp.train import run_folder
from go1exp.train.policy import load_network

DONE = "done.json"
"""In the folder of a step that is finished."""


@dataclass(frozen=True)
class Place:
    """Where a run of this benchmark keeps its files, its size and seed, and how much it does at a time.

    Attributes:
        out: folder of the run.
        size: how much is done.
        seed: of robots, trainings and walks.
        jobs: robots at a time.
        threads: of each search.
        trainings: of each fine-tuned policy.
    """

    out: Path
    size: Size
    seed: int
    jobs: int
    threads: int
    trainings: int = 1

    def named(self, *parts: str) -> Path:
        """Return a folder of it."""
        return self.out.joinpath(*parts)


def finished(folder: Path) -> bool:
    """Return whether the step of this folder was done before."""
    return (folder / DONE).is_file()


def finish(folder: Path, **content: Any) -> None:
    """Note that a step is done, and what came of it."""
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / f".{DONE}"
    partial.write_text(json.dumps(content, indent=1) + "\n")
    partial.rename(folder / DONE)


# ---------------------------------------------------------------------- what the user of the robot does


def trained(place: Place, run: Path, *words: str, seed: int) -> Path:
    """Train into a run folder, or go on with what is there; return it."""
    if not finished(run):
        if list((run / "checkpoints").glob("*.pt")):
            commands.run("train", f"resume={run}")
        else:
            commands.run("train", *place.size.task, *words, f"seed={seed}", f"hydra.run.dir={run}")
        finish(run)
    return run


def walker(place: Place) -> Path:
    """Return the run of the policy that all others start from: trained on the nominal robot."""
    first = trained(place, place.named("first"), *place.size.first, seed=place.seed)
    return trained(place, place.named("walker"), f"start_from={first}", *place.size.walker, seed=place.seed)


def tuned(place: Place, run: Path, *words: str) -> list[Path]:
    """Return the runs of a fine-tuned policy, one of each training: ``run``, ``run_1`` and so on."""
    runs = [run.with_name(f"{run.name}_{k}" if k else run.name) for k in range(place.trainings)]
    start = f"start_from={place.named('walker')}"
    for k, each in enumerate(runs):
        trained(place, each, start, *place.size.tuned, *words, seed=place.seed + k)
    return runs


def searched(place: Place, name: str, support: str) -> dict[str, Any]:
    """Return what ``go1exp gap`` says of a robot by its logs of one support, suspended or on the ground.

    ``file`` is the ``effect.yaml``, which has what is certified; where nothing is, it is empty.
    """
    logs, out = place.named(name, support), place.named(name, f"gap_{support}")
    if not finished(out):
        record(place, name, logs)
        begun = time.monotonic()
        where = (f"logs={logs}", f"out={out}", f"train_dt={place.size.physics_dt}")
        search = ("search.overlays=0", f"search.threads={place.threads}", *place.size.search)
        status = commands.run("gap", *where, *search, allowed=commands.VERDICTS)
        answer = json.loads((out / "verdict.json").read_text())
        names = [f"{n['effect']} ({n['status']})" for n in answer["named"]]
        certain = any(n["status"] == "certified" for n in answer["named"])
        about = {"verdict": answer["verdict"], "named": names, "certain": certain, "exit": status}
        finish(out, logs=support, **about, seconds=round(time.monotonic() - begun, 1))
    return json.loads((out / DONE).read_text()) | {"file": str(out / "effect.yaml")}


def named_effects(place: Place, name: str) -> dict[str, Any]:
    """Return what ``go1exp gap`` says by the suspended logs, or by the standing ones if those give no effect."""
    verdict = searched(place, name, "suspended")
    return verdict if verdict["certain"] else searched(place, name, "ground")


def fitted_net(place: Place, name: str) -> Path:
    """Return the actuator net fitted to suspended recordings of a robot at the gains of its policy."""
    out, logs = place.named(name, "net_fit"), place.named(name, "hung_for_net")
    if not finished(out):
        record(place, name, logs)
        commands.run("fit-actuator", f"recordings={logs}", f"out={out}", *place.size.net)
        finish(out)
    return out / "net.npz"


# ---------------------------------------------------------------------- what the robot does


def deployed(run: Path) -> Policy:
    """Return the newest policy of a run as a bundle would hold it: readings in, joint targets and action out."""
    config = parse_train(run_folder.read_config(run))
    network, _ = load_network(run, config)
    module = DeployedPolicy(network, config.task.observation, config.task.action)

    def policy(readings: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        with torch.no_grad():
            target, _, action = module(*(torch.from_numpy(readings[port.name]) for port in module.inputs))
        return {"joint_target": target.numpy().astype(float), "action": action.numpy().astype(float)}

    return policy


def record(place: Place, name: str, folder: Path) -> None:
    """Write the recordings of a hidden robot, unless they are there; the folder's name says of which kind."""
    if finished(folder):
        return
    size, robot = place.size, hidden.make(name, place.seed, place.size.ground)
    if folder.name == "suspended":
        made = hidden.record_hung(robot, name, place.seed, size.recordings, size.seconds)
    elif folder.name == "hung_for_net":
        made = hidden.record_for_net(robot, name, place.seed, *size.for_net)
    else:
        policy, commanded = deployed(place.named("walker")), np.array(size.commands[:2])
        made = hidden.record_ground(robot, name, place.seed, size.recordings, size.seconds, policy, commanded)
    logger.save(folder, made)
    finish(folder, episodes=len(made))


def evaluate(place: Place, robot: hidden.Hidden, run: Path, file: Path) -> None:
    """Write the errors of a policy's walks on a robot, m/s, and its falls, unless they are there."""
    if not file.is_file():
        size = place.size
        errors, fell = hidden.evaluated(robot, deployed(run), size.commands, size.walks, size.walk_s, place.seed)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"errors": errors.round(6).tolist(), "fell": fell.tolist()}) + "\n")


# ---------------------------------------------------------------------- the whole


def suspended(place: Place, name: str) -> None:
    """Do what a robot needs before there is a policy: suspended logs, the search in them, and the actuator net."""
    searched(place, name, "suspended")
    fitted_net(place, name)


def evaluate_nominal(place: Place) -> None:
    """Let the policy that all others start from walk on the robot of which the model is right."""
    evaluate(place, hidden.nominal(place.size.ground), walker(place), place.named("walks_nominal.json"))


def robot_of(place: Place, name: str) -> tuple[dict[str, Any], dict[str, Walks]]:
    """Record a robot, name its gap, fine-tune, and let all four policies walk on it."""
    suspended(place, name)
    net = place.named(name, "net_fit", "net.npz")
    through_net = ("actuator=net", f"actuator.file={net}", "actuator.period=resample")
    runs = {
        "before": [place.named("walker")],
        "plain": tuned(place, place.named("plain")),
        "net": tuned(place, place.named(name, "net"), *through_net),
    }
    verdict = named_effects(place, name)
    runs["effects"] = tuned(place, place.named(name, "effects"), f"effect={verdict['file']}")
    robot = hidden.make(name, place.seed, place.size.ground)
    walks = {}
    for policy, of_policy in runs.items():
        endings = [run.name.removeprefix(of_policy[0].name) for run in of_policy]
        files = [place.named(name, f"walks_{policy}{ending}.json") for ending in endings]
        for run, file in zip(of_policy, files, strict=True):
            evaluate(place, robot, run, file)
        walks[policy] = Walks.read(*files)
    return verdict, walks


def in_turn(place: Place, names: Sequence[str]) -> Iterator[tuple[dict[str, Any], dict[str, Walks]]]:
    """Yield what came of each robot, in order, ``jobs`` of them at a time.

    Several at a time begin with what needs no policy, while the first ones are trained.
    """
    if place.jobs == 1:
        walker(place)
        tuned(place, place.named("plain"))
        evaluate_nominal(place)
        yield from (robot_of(place, name) for name in names)
        return
    with ProcessPoolExecutor(place.jobs, get_context("spawn"), torch.set_num_threads, (1,)) as pool:
        early = {pool.submit(suspended, place, name): name for name in names}
        walker(place)
        tuned(place, place.named("plain"))
        nominal = pool.submit(evaluate_nominal, place)
        whole: dict[str, Future[tuple[dict[str, Any], dict[str, Walks]]]] = {}
        for done in as_completed(early):
            done.result()
            whole[early[done]] = pool.submit(robot_of, place, early[done])
        nominal.result()
        yield from (whole[name].result() for name in names)


def settled(given: Mapping[str, str]) -> tuple[Place, tuple[str, ...]]:
    """Read the arguments; return the place of the run, and its robots.

    Raises:
        SystemExit: if one is wrong, or the folder holds a run of another size or seed.
    """
    usage = (
        f"usage: python -m benchmarks.closed_loop out=DIR [size={'|'.join(SIZES)}] [robots=NAME,NAME] [trainings=1] "
        f"[seed=0] [jobs=1] [threads=INT]\nrobots: {', '.join(hidden.SECRETS)}"
    )
    if not {"out"} <= set(given) <= {"out", "size", "robots", "trainings", "seed", "jobs", "threads"}:
        raise SystemExit(usage)
    name = given.get("size", "full")
    if name not in SIZES:
        raise SystemExit(f"size={name}: must be one of {', '.join(SIZES)}\n{usage}")
    try:
        seed, jobs, trainings = (int(given.get(*pair)) for pair in (("seed", 0), ("jobs", 1), ("trainings", 1)))
        threads = int(given.get("threads", max((os.cpu_count() or 1) // max(jobs, 1), 1)))
    except ValueError as error:
        raise SystemExit(f"seed, jobs, threads and trainings must be whole numbers: {error}\n{usage}") from None
    if min(jobs, threads, trainings) < 1:
        raise SystemExit(f"jobs={jobs} threads={threads} trainings={trainings}: each must be at least 1\n{usage}")
    robots = tuple(given["robots"].split(",")) if "robots" in given else SIZES[name].robots
    for robot in robots:
        if robot not in hidden.SECRETS:
            raise SystemExit(f"robots: {robot!r} must be one of {', '.join(hidden.SECRETS)}\n{usage}")
    place = Place(Path(given["out"]).resolve(), SIZES[name], seed, jobs, threads, trainings)
    settings = json.loads(json.dumps({**asdict(place.size), "seed": seed}))
    del settings["robots"]  # others may be added
    file = place.named("settings.json")
    if file.is_file() and json.loads(file.read_text()) != settings:
        raise SystemExit(f"{place.out}: holds a run with another size or seed; take another folder")
    place.out.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(settings, indent=1) + "\n")
    return place, robots


def main(arguments: Sequence[str]) -> None:
    """Close the loop on every robot, print the table and write the figures."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    place, robots = settled(given if len(given) == len(arguments) else {})
    torch.set_num_threads(1)
    begun = time.monotonic()
    rows, walks = [], []
    for count, (name, (verdict, of_robot)) in enumerate(zip(robots, in_turn(place, robots), strict=True), start=1):
        nominal = Walks.read(place.named("walks_nominal.json"))
        walks.append(of_robot)
        rows.append(row_of(name, verdict, nominal, of_robot))
        print(f"robot {count}/{len(robots)}, {(time.monotonic() - begun) / 60:.1f} min\n{table(rows)}\n", flush=True)
    write_table(place.out, rows)
    command = f"python -m benchmarks.closed_loop size={given.get('size', 'full')} seed={place.seed} "
    command += f"trainings={place.trainings} " if place.trainings > 1 else ""
    write_results(
        place.named("closed_loop.json"), f"{command}robots={','.join(robots)}", figures_of(rows, nominal, walks)
    )
    print(f"written to {place.out}")


if __name__ == "__main__":
    main(sys.argv[1:])
