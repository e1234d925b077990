"""Whether a training fits into memory, asked before anything is built: the system would end it without a word later."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from go1exp import robot
from go1exp.config import TrainConfig
from go1exp.schema.backends import WarpBackend
from go1exp.schema.registry import ConfigError

CPU_ROBOT_BYTES = 6000
"""One more robot on the CPU: physics state, own model fields, the MDP's tensors (measured: 6.2 kB at 4096)."""

CONTACT_BYTES = 100
"""A contact that MuJoCo Warp has room for: positions, frame, solver parameters, geoms."""

FLOAT = 4
DEGREES_OF_FREEDOM = 6 + robot.NUM_JOINTS


def needed_bytes(config: TrainConfig) -> int:
    """Return a lower bound of the memory that a training takes on each device, B.

    What fails for certain is refused, nothing else.
    Robots; the rollout once (observations of one number a term, actions, their means, six numbers a step); the layers'
    outputs of one minibatch, and of its mirror image, which wait for the backward pass.
    """
    ppo, backend, devices = config.ppo, config.task.backend, config.process.devices
    per_robot = CPU_ROBOT_BYTES
    if isinstance(backend, WarpBackend):
        per_robot = FLOAT * DEGREES_OF_FREEDOM * backend.njmax + CONTACT_BYTES * backend.nconmax
    row = len(config.task.observation) + len(config.task.critic) + 2 * robot.NUM_JOINTS + 6
    rollout = ppo.num_envs * ppo.steps
    samples = rollout // ppo.minibatches * (2 if ppo.symmetry else 1)
    outputs = samples * 2 * sum(ppo.hidden)
    return ppo.num_envs * per_robot // devices + FLOAT * (rollout * row + outputs // devices)


def check(config: TrainConfig, device: torch.device) -> None:
    """Refuse a training that cannot fit.

    Args:
        config: what is to be trained.
        device: where most of it lies.

    Raises:
        ConfigError: with what it takes and what there is.
    """
    needed, available = needed_bytes(config), _available(device)
    if available is not None and needed > available:
        where = f"on {device}" if device.type == "cuda" else "in memory"
        raise ConfigError(
            [
                f"ppo.num_envs = {config.ppo.num_envs}: with ppo.steps = {config.ppo.steps} it takes at least "
                f"{needed / 1e9:.1f} GB, and {available / 1e9:.1f} GB are free {where}"
            ]
        )


def _available(device: torch.device) -> int | None:
    """Return the free memory of a device, B; None where the system does not tell."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    amounts = [amount for amount in (_of_machine(), _of_group(Path("/proc/self/cgroup"))) if amount is not None]
    return min(amounts, default=None)


def _of_machine() -> int | None:
    """Return the machine's memory that can be had without swapping, B."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (OSError, ValueError):
        return None


def _of_group(membership: Path, root: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Return what the limits of this process's control groups (containers, Slurm jobs) leave, B; None without one."""
    try:
        lines = membership.read_text().splitlines()
    except OSError:
        return None
    left: list[int] = []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            names, base = ("memory.max", "memory.stat", "anon"), root
        elif "memory" in controllers.split(","):
            names, base = ("memory.limit_in_bytes", "memory.stat", "rss"), root / "memory"
        else:
            continue
        group = base / path.strip("/")
        for folder in (group, *group.parents):  # a limit of any of them holds
            left += _left_in(folder, *names)
            if folder == base:
                break
    return min(left, default=None)


def _left_in(folder: Path, limit: str, statistics: str, used: str) -> list[int]:
    """Return a group's limit less what its processes use (the disk's cache gives way); empty if unlimited."""
    try:
        most = int((folder / limit).read_text())
        figures = dict(line.split() for line in (folder / statistics).read_text().splitlines())
    except (OSError, ValueError):
        return []
    return [most - int(figures.get(used, 0))]
