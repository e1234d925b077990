"""A Ray cluster of this machine, for tests: a head without cores and nodes beside it, each a raylet, all on loopback.

``python tests/ray_cluster.py FOLDER COMMAND...`` starts it, runs the command with ``RAY_ADDRESS``, and ends it. Ray
takes the machine's own address whatever it is told; in a network of its own (``unshare -n``) that is 127.0.0.1.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

PORT = 26379
OPTIONS = ("--disable-usage-stats", "--object-store-memory=80000000", "--block")


def start(folder: Path, *options: str) -> subprocess.Popen[bytes]:
    """Start one node in a session of its own."""
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", *options, *OPTIONS]
    with (folder / "ray.log").open("a") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)


def main(folder: Path, command: list[str]) -> int:
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    os.environ |= {"RAY_AUTH_MODE": "disabled", "RAY_BACKEND_LOG_LEVEL": "fatal"}
    address = f"127.0.0.1:{PORT}"
    head = (
        "--head",
        f"--port={PORT}",
        "--node-ip-address=127.0.0.1",
        "--include-dashboard=false",
        f"--temp-dir={(place := tempfile.mkdtemp(prefix='r'))}",  # the path of a socket has at most 107 bytes
    )
    nodes = [start(folder, *head, "--num-cpus=0")]
    try:
        for number in range(2):
            ready = subprocess.run([sys.executable, "-c", WAIT, address, str(number + 1)], timeout=120)
            assert ready.returncode == 0, (folder / "ray.log").read_text()
            nodes.append(start(folder, f"--address={address}", "--num-cpus=1", "--node-ip-address=127.0.0.1"))
        assert subprocess.run([sys.executable, "-c", WAIT, address, "3"], timeout=120).returncode == 0
        (folder / "nodes.txt").write_text("\n".join(str(node.pid) for node in nodes))
        return subprocess.run(command, env={**os.environ, "RAY_ADDRESS": address}).returncode
    finally:
        for node in reversed(nodes):
            end(node.pid)
            node.wait()
        shutil.rmtree(place, ignore_errors=True)


def end(session: int) -> None:
    """Kill a node with all that it has started."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            of = int((process / "stat").read_text().rpartition(")")[2].split()[3])
            if of == session:
                os.kill(int(process.name), signal.SIGKILL)
        except (OSError, ValueError, IndexError):
            continue


WAIT = """
import sys, time, ray
for _ in range(100):
    try:
        ray.init(address=sys.argv[1], logging_level="ERROR", log_to_driver=False)
        while sum(node["Alive"] for node in ray.nodes()) < int(sys.argv[2]):
            time.sleep(0.2)
        sys.exit(0)
    except ConnectionError:
        time.sleep(0.5)
sys.exit(1)
"""

if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
