"""Jobs as Ray tasks: on a running cluster, or on one that is started here for this sweep.

A task starts the training in a process of its own and waits. When a node dies, Ray starts its tasks again on another;
the training goes on from its checkpoint, which lies in a folder that all nodes see.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import socket
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal

from pydantic import Field

from go1exp.base.errors import Expected
from go1exp.config.schema.registry import ConfigError, Count, CountOrZero
from go1exp.config.schema.settings import settings
from go1exp.train.sweep import command
from go1exp.train.sweep.command import Ended, Task, Watch


@settings
class RaySettings:
    """``conf/launcher/ray.yaml``: jobs as Ray tasks.

    Attributes:
        name: ray.
        address: of a running cluster, auto for the one of this machine; null starts one here for this sweep.
        cpus: cores of a job.
        gpus: GPUs of a job; less than 1 lets jobs share one.
        retries: times that a job is started again when its node dies; it goes on from its checkpoint.
    """

    name: Literal["ray"]
    address: str | None
    cpus: Count
    gpus: Annotated[float, Field(ge=0)]
    retries: CountOrZero


LOOK_S = 2.0
"""Time between two looks at the run folders, s."""

STOP_S = 120.0
"""Time for the checkpoints of jobs that are stopped, s."""

QUIET = {"RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0", "RAY_BACKEND_LOG_LEVEL": "fatal", "RAY_USAGE_STATS_ENABLED": "0"}
"""Variables for Ray: one line from us instead of many, send no usage statistics, and leave CUDA_VISIBLE_DEVICES as
it is for CPU jobs."""


class Ray:
    """Tasks of Ray."""

    remote = True

    def __init__(self, settings: RaySettings) -> None:
        self.settings = settings

    def check(self) -> None:
        """Refuse where Ray is missing, or its cluster."""
        if importlib.util.find_spec("ray") is None:
            raise ConfigError(["hydra/launcher=ray needs the package ray: pip install 'go1exp[ray]'"])
        self._connect()

    def launch(self, folder: Path, tasks: Sequence[Task], watch: Watch) -> None:
        """Run the tasks (see ``Launcher``)."""
        import ray

        try:
            self._connect()
            run = ray.remote(
                num_cpus=self.settings.cpus, num_gpus=self.settings.gpus, max_retries=self.settings.retries
            )(command.run)
            references = {run.remote(task.command): task for task in tasks}
            try:
                _follow(ray, references, watch)
            except KeyboardInterrupt:
                _stop(ray, list(references))
                raise
        finally:
            ray.shutdown()  # of a private one, the processes; of another, our connection: its tasks of ours end

    def _connect(self) -> None:
        for name, value in QUIET.items():
            os.environ.setdefault(name, value)
        import ray

        if ray.is_initialized():
            return
        address = self.settings.address
        _refuse_silence(address)
        try:
            if address is None:
                ray.init(address="local", include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
            else:
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except Exception as error:  # ConnectionError and others, by how the cluster is missing
            where = "a private cluster could not be started" if address is None else f"no cluster at {address!r}"
            reason = " ".join(str(error).split())[:200]
            raise Expected(f"ray: {where} ({reason}); hydra.launcher.address=null starts one here") from None
        from ray import cloudpickle

        cloudpickle.register_pickle_by_value(command)  # the workers of a cluster need not find this package
        self._fits(ray)

    def _fits(self, ray: ModuleType) -> None:
        """Refuse jobs that no node could ever run: they would wait for ever."""
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        wanted = {"CPU": float(self.settings.cpus), "GPU": self.settings.gpus}
        if not any(all(node.get(kind, 0.0) >= need for kind, need in wanted.items()) for node in nodes):
            most = {kind: max((node.get(kind, 0.0) for node in nodes), default=0.0) for kind in wanted}
            raise ConfigError(
                [
                    f"hydra.launcher.cpus = {self.settings.cpus}, hydra.launcher.gpus = {self.settings.gpus:g}: no "
                    f"node of Ray's cluster has as many; the largest have {most['CPU']:g} cores, {most['GPU']:g} GPUs"
                ]
            )


def _refuse_silence(address: str | None) -> None:
    """Raise Expected naming an address at which no server listens: Ray itself would try for minutes."""
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if not colon or not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), timeout=5.0).close()
    except OSError as error:
        why = error.strerror or error
        raise Expected(f"ray: no cluster at {address!r} ({why}); hydra.launcher.address=null starts one here") from None


def _follow(ray: ModuleType, tasks: dict[Any, Task], watch: Watch) -> None:
    """Tell of each task when it ends, now and then of those that have begun; raise Expected if the cluster leaves."""
    left = list(tasks)
    while left:
        ended, left = ray.wait(left, num_returns=1, timeout=LOOK_S)
        for reference in ended:
            watch.ended(tasks[reference], _result(ray, reference))
        watch.changed()


def _stop(ray: ModuleType, references: list[Any]) -> None:
    """Have the tasks end with a checkpoint, and wait for that."""
    print("\nstopping the jobs after the iteration under way, with a checkpoint", file=sys.stderr, flush=True)
    for reference in references:
        ray.cancel(reference)  # a KeyboardInterrupt in the worker, which ends the training and waits for it
    ray.wait(references, num_returns=len(references), timeout=STOP_S)


def _result(ray: ModuleType, reference: Any) -> Ended:
    try:
        how: Ended = ray.get(reference)
    except Exception as error:  # Ray's own: the node died too often, the task was cancelled
        return Ended(1, f"ray: {' '.join(str(error).split())[:200]}")
    return how
