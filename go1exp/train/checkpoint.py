"""Checkpoints: everything that training needs to go on as if it had never stopped.

One file per checkpoint, written under a temporary name and renamed when complete, read back without unpickling code.
"""

from __future__ import annotations

import errno
import io
import random
import warnings
import zipfile
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import torch

from go1exp.base.errors import Unusable
from go1exp.base.files import opened
from go1exp.train.ppo import AdaptivePPO

FORMAT = 1
SUFFIX = ".pt"

ROBOTS = ("env", "last_obs", "last_episode_starts")
"""Parts of a checkpoint that belong to the robots; of several GPUs, each has its own."""


class DamagedCheckpoint(Unusable):
    """A checkpoint that is not whole, or none at all; the message names the file."""


def checkpoints(run: Path) -> list[Path]:
    """Return the complete checkpoints of a run folder, oldest first."""
    return sorted((run / "checkpoints").glob(f"*{SUFFIX}"))


def iterations_done(run: Path) -> int:
    """Return the iteration of a run folder's newest checkpoint, by its name; 0 without one."""
    numbers = [int(path.stem) for path in checkpoints(run) if path.stem.isdigit()]
    return max(numbers, default=0)


def save(ppo: AdaptivePPO, run: Path, keep: int) -> Path:
    """Write the present state as the newest checkpoint and delete all but ``keep``.

    In a group all members call this, and the first one writes the state of all robots.

    Raises:
        OSError: if it cannot be written; the checkpoints that are there stay.
    """
    final = run / "checkpoints" / f"{ppo.iteration:06d}{SUFFIX}"
    state = _state(ppo)
    if not ppo.group.first:
        return final
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        with opened(final) as file:
            torch.save(state, file)
    except (OSError, RuntimeError) as error:  # torch's zip writer covers the system's errors with its own
        cause = error.__context__ if isinstance(error.__context__, OSError) else error
        number, reason = (cause.errno, cause.strerror) if isinstance(cause, OSError) else (errno.EIO, str(cause))
        raise OSError(number, f"checkpoint cannot be written: {reason}", str(final)) from error
    for old in checkpoints(run)[:-keep]:
        old.unlink()
    return final


def load_latest(run: Path) -> tuple[dict[str, Any], Path]:
    """Read the newest checkpoint that is whole; a damaged one is skipped with a warning of one line.

    Raises:
        FileNotFoundError: if the folder holds none.
        DamagedCheckpoint: if none of those that it holds can be read.
    """
    files = checkpoints(run)
    for path in reversed(files):
        try:
            return read(path), path
        except DamagedCheckpoint as error:
            warnings.warn(f"{error}; skipped", stacklevel=2)
    if files:
        raise DamagedCheckpoint(f"{run}: none of its {len(files)} checkpoints can be read")
    raise FileNotFoundError(f"{run}: no checkpoint to load (looked for checkpoints/*{SUFFIX})")


def read(path: Path) -> dict[str, Any]:
    """Read one checkpoint.

    Raises:
        DamagedCheckpoint: if it is not whole, no checkpoint, one of a version that is not known here, or one whose
            policy has a weight that is not finite.
        OSError: if the file cannot be opened.
    """
    data = io.BytesIO(path.read_bytes())  # first: torch's reader has an OSError for a file that is cut off, too
    try:
        with zipfile.ZipFile(data) as archive:  # torch does not compare the sums of its members
            if archive.testzip():
                raise zipfile.BadZipFile
        data.seek(0)
        state: Any = torch.load(data, map_location="cpu", weights_only=True)
    except Exception:  # in many ways, and torch's own words advise to run the code that the file may hold
        raise DamagedCheckpoint(f"{path}: damaged checkpoint (not whole, or not written by go1exp)") from None
    known = state.get("format") if isinstance(state, dict) else None
    if known != FORMAT:
        raise DamagedCheckpoint(f"{path}: checkpoint format {known!r}, this version reads {FORMAT}")
    wrong = [name for name, weight in state["policy"].items() if not weight.isfinite().all()]
    if wrong:
        raise DamagedCheckpoint(f"{path}: damaged checkpoint (weights of the policy are not finite: {wrong[0]})")
    return state


def restore(ppo: AdaptivePPO, state: dict[str, Any]) -> None:
    """Put ``ppo`` and its environment into the state of a checkpoint.

    Raises:
        DamagedCheckpoint: if a part of this version's environment is missing in it; the learner is as it was.
    """
    core = ppo.core
    try:
        core.load_state_dict(ppo.group.part(state["env"], core.num_envs))
    except KeyError as missing:
        raise DamagedCheckpoint(
            f"a checkpoint of another version of go1exp: it has no {missing}; go on with that version, or begin a new "
            "run with its weights (start_from=)"
        ) from None
    ppo.policy.load_state_dict(state["policy"])
    ppo.policy.optimizer.load_state_dict(state["optimizer"])
    ppo.iteration = state["iteration"]
    ppo.num_timesteps = state["num_timesteps"]
    ppo.schedule.load_state_dict(state.get("schedule", {}), ppo.num_timesteps)
    ppo._n_updates = state["n_updates"]
    # SB3 makes these two when learning starts, unless the first is there already.
    ppo.ep_info_buffer = deque(state["episodes"], maxlen=ppo._stats_window_size)
    ppo.ep_success_buffer = deque(maxlen=ppo._stats_window_size)
    last = ppo.group.part([state["last_obs"], state["last_episode_starts"]], core.num_envs)
    ppo._last_obs, ppo._last_episode_starts = (each.numpy() for each in last)
    rng = state["rng"]
    torch.set_rng_state(rng["torch"])
    if rng["cuda"] is not None and torch.cuda.is_available():
        torch.cuda.set_rng_state(rng["cuda"])
    kind, keys, position, has_gauss, cached = rng["numpy"]
    np.random.set_state((kind, keys.numpy().astype(np.uint32), position, has_gauss, cached))  # noqa: NPY002 (SB3's)
    version, state_words, gauss = rng["python"]
    random.setstate((version, tuple(state_words), gauss))


def _state(ppo: AdaptivePPO) -> dict[str, Any]:
    kind, keys, position, has_gauss, cached = np.random.get_state(legacy=True)  # noqa: NPY002 (SB3 draws from it)
    version, state_words, gauss = random.getstate()
    assert ppo.ep_info_buffer is not None
    assert isinstance(ppo._last_obs, np.ndarray)
    core, starts = ppo.core, np.asarray(ppo._last_episode_starts)
    local = (core.state_dict(), torch.from_numpy(ppo._last_obs.copy()), torch.from_numpy(starts.copy()))
    schedule = ppo.schedule.state_dict()
    return {
        "format": FORMAT,
        "iteration": ppo.iteration,
        "num_timesteps": ppo.num_timesteps,
        "n_updates": ppo._n_updates,
        "episodes": list(ppo.ep_info_buffer),
        "policy": ppo.policy.state_dict(),
        "optimizer": ppo.optimizer_state(),
        **ppo.group.whole(dict(zip(ROBOTS, local, strict=True)), core.num_envs),
        **({"schedule": schedule} if schedule else {}),
        "rng": {
            "torch": torch.get_rng_state(),
            "cuda": torch.cuda.get_rng_state() if torch.cuda.is_available() else None,
            "numpy": [kind, torch.from_numpy(np.asarray(keys).astype(np.int64)), position, has_gauss, cached],
            "python": [version, list(state_words), gauss],
        },
    }
