"""The command line for tests: exit status and both streams.

``refuse`` runs it in pytest's process: for settings that are refused. ``run`` forks it from a process that has already
imported what the command line imports, which costs a tenth of a second instead of several, and leaves nothing in
pytest's process. ``run_alone`` starts a new interpreter as a user does; a few smoke tests need no less.
"""

from __future__ import annotations

import atexit
import io
import json
import os
import select
import signal
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

from go1exp.base.paths import data_root
from go1exp.cli import ONE_BLAS_THREAD, main

COMMAND_LINE = "import sys; from go1exp.cli import main; sys.exit(main())"

WITH_MODULES = """
import json, os, sys
from go1exp.cli import main
try:
    sys.exit(main())
finally:
    with open(os.environ["MODULES"], "w") as file:
        json.dump(list(sys.modules), file)
"""
"""The command line, and afterwards the names of all loaded modules in the file ``$MODULES``."""

COMPOSED = """
from go1exp.config.compose import compose
compose("train", ["seed=1", "ppo.hidden=[8]"])  # Hydra has looked for its plugins, and its parsers know their grammars
"""

LIGHT = f"""{COMPOSED}
from go1exp.cli import EVERY
from go1exp.cli.app import app_of, defer
defer("torch")
for verb in EVERY:
    app_of(verb)
import go1exp.sim.task, go1exp.logs.excitations, go1exp.logs.importers
"""
"""What a refusal needs: neither torch nor an engine. A refusal that loads them is seen, as they are not there yet."""

WARM = f"""{COMPOSED}
import torch, mujoco, stable_baselines3
import torch._dynamo  # an optimiser imports it: 1.5 s
import go1exp.train.trainer, go1exp.evaluate, go1exp.logs.record.simulate, go1exp.logs.excitations
import go1exp.logs.importers
import go1exp.logs.audit, go1exp.logs.audit.checks, go1exp.gap.actuator_net.fitting, go1exp.cli.app
"""
"""What work needs."""

SERVER = """
import atexit, gc, json, os, signal, sys, threading, traceback
exec(sys.argv[1], {"__name__": "preload"})
threads = len(os.listdir("/proc/self/task")) if os.path.isdir("/proc/self/task") else 1
assert threads == 1, f"{threads} threads: a fork would have one of them, and the locks of all"
requests, answers = os.fdopen(os.dup(0), "r"), os.fdopen(os.dup(1), "w")
gc.freeze()  # a collection would touch, and so copy, every page
print("ready", file=answers, flush=True)
for line in requests:
    request = json.loads(line)
    child = os.fork()
    if child:
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), file=answers, flush=True)
        continue
    os.close(requests.fileno())
    os.close(answers.fileno())
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where pytest runs in a shell's background
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["environment"])
    for number, (path, flags) in enumerate(request["files"]):
        opened = os.open(path, flags, 0o600)
        os.dup2(opened, number)
        os.close(opened)
    sys.stdin = open(0, closefd=False)
    sys.stdout = sys.__stdout__ = open(1, "w", closefd=False)
    sys.stderr = sys.__stderr__ = open(2, "w", closefd=False, errors="backslashreplace", buffering=1)
    sys.argv = ["-c", *request["arguments"]]
    status = 0
    try:
        exec(compile(request["code"], "<string>", "exec"), {"__name__": "__main__"})
    except SystemExit as leaving:
        status = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
    except KeyboardInterrupt:  # an interpreter ends itself by the signal
        traceback.print_exc()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    except BaseException:
        traceback.print_exc()
        status = 1
    threading._shutdown()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    os._exit(status)  # tidying up all that was imported takes longer than the rest
"""


class Server:
    """A process that has imported what ``preload`` imports, and forks itself for each command."""

    def __init__(self, preload: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", SERVER, preload],
            env=environment(**dict([ONE_BLAS_THREAD])),  # a process of one thread can be forked
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C ends pytest, which ends this
        )
        atexit.register(self.close)
        assert self._answer(600.0) == "ready"

    def close(self) -> None:
        self._process.communicate()

    def run(
        self, cwd: Path, arguments: tuple[str, ...], code: str, variables: dict[str, str], timeout: float
    ) -> subprocess.CompletedProcess[str]:
        """Run ``code`` in a fork; raise TimeoutExpired where it takes longer than ``timeout`` seconds."""
        assert self._process.stdin is not None
        with TemporaryDirectory() as folder:
            written = [Path(folder) / name for name in ("stdout", "stderr")]
            flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
            request: dict[str, Any] = {
                "cwd": str(cwd),
                "arguments": arguments,
                "code": code,
                "environment": variables,
                "files": [(os.devnull, os.O_RDONLY), *((str(path), flags) for path in written)],
            }
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
            status = self._answer(timeout)
            if status is None:
                self._give_up()
                raise subprocess.TimeoutExpired(["go1exp", *arguments], timeout)
            texts = [path.read_text() for path in written]
        return subprocess.CompletedProcess(["go1exp", *arguments], int(status), *texts)

    def _give_up(self) -> None:
        """Kill this process and its fork; the next command begins with a new one."""
        os.killpg(self._process.pid, signal.SIGKILL)
        server.cache_clear()

    def _answer(self, timeout: float) -> str | None:
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], timeout)
        return self._process.stdout.readline().strip() if ready else None


@cache
def server(preload: str) -> Server:
    """Return the server of this process with those imports, started at its first use."""
    return Server(preload)


def environment(**changes: str) -> dict[str, str]:
    """Return the variables of this process without those that change what the command line prints or opens."""
    inherited = {k: v for k, v in os.environ.items() if k not in ("HYDRA_FULL_ERROR", "DISPLAY", "WAYLAND_DISPLAY")}
    path = os.pathsep.join([str(data_root()), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**inherited, "PYTHONPATH": path, **changes}


def refuse(cwd: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run ``go1exp ARGUMENTS``, which do no work, in this process."""
    out, err = io.StringIO(), io.StringIO()
    with (
        chdir(cwd),
        mock.patch.object(sys, "argv", ["go1exp", *arguments]),
        mock.patch.dict(os.environ, environment(), clear=True),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            status = main()
        except SystemExit as leaving:
            status = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
    return subprocess.CompletedProcess(["go1exp", *arguments], status, out.getvalue(), err.getvalue())


def run(
    cwd: Path, *arguments: str, code: str = COMMAND_LINE, preload: str = WARM, timeout: float = 300.0, **changes: str
) -> subprocess.CompletedProcess[str]:
    """Run ``go1exp ARGUMENTS`` in a fork; ``changes`` are environment variables."""
    return server(preload).run(cwd, arguments, code, environment(**changes), timeout)


def run_alone(
    cwd: Path, *arguments: str, code: str = COMMAND_LINE, timeout: float = 300.0, **changes: str
) -> subprocess.CompletedProcess[str]:
    """Run ``go1exp ARGUMENTS`` in a new interpreter; ``changes`` are environment variables."""
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=cwd,
        env=environment(**changes),
        capture_output=True,
        text=True,
        timeout=timeout,
    )
