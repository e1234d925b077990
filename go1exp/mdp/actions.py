"""What an action means: a change of the joints' position targets about the nominal stance."""

from __future__ import annotations

from torch import Tensor


def clipped(action: Tensor, clip: float) -> Tensor:
    """Cut a policy's output (N, 12) at +-``clip``: the action in force, which the policy observes as its last one."""
    return action.clamp(-clip, clip)


def of_shape(action: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return ``action``; raise ValueError where it has not one row for each robot: torch would spread it out."""
    if tuple(action.shape) != tuple(shape):
        raise ValueError(f"action has shape {tuple(action.shape)}; needed is {tuple(shape)}, one row for each robot")
    return action


def joint_target(action: Tensor, nominal: Tensor, scale: float) -> Tensor:
    """Return position targets (N, 12), rad: nominal stance (12,) + ``scale`` (rad) x clipped action (N, 12)."""
    return nominal + scale * action
