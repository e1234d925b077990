"""A Slurm cluster of this machine alone, for tests: munged, slurmctld and slurmd as Debian has them, all on 127.0.0.1.

``python tests/slurm_cluster.py FOLDER`` starts one, prints the variable that its commands need, and ends it at Ctrl-C.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

DAEMONS = ("munged", "slurmctld", "slurmd")

CONF = """
ClusterName=go1exp
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
SlurmdPort={next_port}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge/s,cred_expire=5
CredType=cred/munge
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
StateSaveLocation={folder}/ctld
SlurmdSpoolDir={folder}/slurmd
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
MailProg=/bin/true
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
ReturnToService=2
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerType=sched/backfill
SchedulerParameters=sched_interval=1,batch_sched_delay=0,bf_interval=1
KillWait=5
MinJobAge=300
SlurmctldTimeout=30
SlurmdTimeout=60
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory={memory} State=UNKNOWN
PartitionName=cpu Nodes=ALL Default=YES MaxTime=INFINITE State=UP OverSubscribe=NO
"""
# No accounting: a database is more than small clusters have. cred_expire: a job that starts again waits as long.
# proctrack, task and jobacct without cgroups. NoInAddrAny: nothing listens but on 127.0.0.1.


def missing() -> str:
    """What is not here; empty if a cluster can be started."""
    absent = [name for name in (*DAEMONS, "sbatch", "srun") if _program(name) is None]
    if absent:
        return f"no {', '.join(absent)}: apt-get install slurm-wlm munge"
    return "" if os.getuid() == 0 else "Slurm's daemons start as root only"


@contextmanager
def of_a_test(folder: Path) -> Iterator[dict[str, str]]:
    """Start a cluster for a test, which is skipped where none can be, or fails by ``make test-slurm``."""
    lacking = missing()
    if importlib.util.find_spec("submitit") is None:
        lacking = lacking or "no submitit: pip install 'go1exp[slurm]'"
    if lacking and os.environ.get("GO1EXP_TEST_SLURM"):
        pytest.fail(lacking)
    elif lacking:
        pytest.skip(f"{lacking}; make test-slurm")
    with cluster(folder) as variables:
        yield variables


def _program(name: str) -> str | None:
    return shutil.which(name, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")


@contextmanager
def cluster(folder: Path) -> Iterator[dict[str, str]]:
    """Start one with all of its state in ``folder``; give the variables of its commands; end it by the daemons' ids."""
    port = _free_port()
    for name in ("munge", "ctld", "slurmd"):
        (folder / name).mkdir(parents=True)
    folder.chmod(0o755)
    (folder / "munge").chmod(0o700)
    key = folder / "munge/key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o600)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20  # MB
    host = os.uname().nodename.split(".")[0]
    text = CONF.format(
        host=host, port=port, next_port=port + 1, folder=folder, cores=os.cpu_count(), memory=int(memory * 0.9)
    )
    (folder / "slurm.conf").write_text(text)
    variables = {"SLURM_CONF": str(folder / "slurm.conf")}
    munged = [f"--{what}-file={folder}/munge/{what}" for what in ("key", "pid", "log", "seed")]
    try:
        _started("munged", "--force", *munged, f"--socket={folder}/munge/s", "--num-threads=2")
        _started("slurmctld", "-c", **variables)
        _started("slurmd", "-c", **variables)
        _await(lambda: "idle" in _answer("sinfo", "-h", "-o", "%T", **variables), "the node is not idle", 30.0)
        yield variables
    finally:
        _answer("scancel", "--me", **variables)
        for _ in range(50):
            if not _answer("squeue", "-h", **variables).strip():
                break
            time.sleep(0.2)
        for name in ("slurmd.pid", "slurmctld.pid", "munge/pid"):
            _end(folder / name)


def _free_port() -> int:
    """Return the first of two ports in a row that nobody listens on."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    for port in range(26817 + 100 * worker, 28000, 2):
        with (
            suppress(OSError),
            socket.create_server(("127.0.0.1", port)),
            socket.create_server(("127.0.0.1", port + 1)),
        ):
            return port
    raise AssertionError("no two free ports")


def _started(name: str, *options: str, **variables: str) -> None:
    program = _program(name)
    assert program is not None
    done = subprocess.run([program, *options], capture_output=True, text=True, env={**os.environ, **variables})
    assert done.returncode == 0, f"{name}: {done.stdout}{done.stderr}"


def _answer(*words: str, **variables: str) -> str:
    with suppress(subprocess.TimeoutExpired):
        return subprocess.run(
            words, capture_output=True, text=True, timeout=5.0, env={**os.environ, **variables}
        ).stdout
    return ""


def _await(holds: Callable[[], bool], otherwise: str, seconds: float) -> None:
    limit = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < limit, otherwise
        time.sleep(0.1)


def _end(pid_file: Path) -> None:
    """End the daemon whose id is in the file, and wait until it is gone."""
    with suppress(OSError, ValueError):
        pid = int(pid_file.read_text())
        os.kill(pid, signal.SIGTERM)
        for patience in range(100):
            if not Path(f"/proc/{pid}").exists() or "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text():
                return
            time.sleep(0.1)
            if patience == 60:
                os.kill(pid, signal.SIGKILL)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in a shell's background
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with cluster(Path(sys.argv[1]).absolute()) as needed:
        print(" ".join(f"{key}={value}" for key, value in needed.items()), flush=True)
        with suppress(KeyboardInterrupt):
            signal.pause()
