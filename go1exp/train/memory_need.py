"""Whether a training fits into memory, asked before anything is built: the system would end it without a word later."""

from __future__ import annotations

import torch

from go1exp import robot
from go1exp.base import memory
from go1exp.config.schema.backends import WarpBackend
from go1exp.config.schema.registry import ConfigError
from go1exp.sim.task import TrainConfig

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
    return memory.free()
