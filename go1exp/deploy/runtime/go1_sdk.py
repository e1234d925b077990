"""A link to the real Go1 through the vendor's SDK (``unitree_legged_sdk`` 3.8, its binding ``robot_interface``).

It has been run against the simulated robot by the vendor's binary, never on hardware. Names, ports and rates are those
of the SDK's own low-level example. ``robot=go1`` needs no binding.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from go1exp.deploy.runtime.go1_wire import JOINTS, LOW_LEVEL, PERIOD, ROBOT, ROBOT_PORT, SERVO, Health
from go1exp.deploy.runtime.launch import RobotError
from go1exp.deploy.runtime.safety import DEFAULT_KD
from go1exp.deploy.runtime.udp import Traffic
from go1exp.robot.messages import LowCmd, LowState

MODULES = ("robot_interface", "unitree_legged_sdk.robot_interface")
"""Names of the binding: as the SDK's build leaves it, and as the package unitree-legged-sdk has it."""

LOCAL_PORT = 8080

POWER_LEVEL = 5
"""Level of the SDK's PowerProtect, of 1 to 10: 500 W, as in ``SafetyConfig.power``."""

SILENCE = 0.05
"""The drives are commanded to brake when the runtime has sent no command for this time, s."""


class SdkLink:
    """Exchanges states and commands every 2 ms in a thread of its own, at any rate of the runtime.

    Only that thread calls the SDK. Before the first command it asks for nothing, as ``udp.Go1Link`` does. If the
    runtime stops sending commands, the drives brake.

    Attributes:
        sent_at: NaN: the thread sends.
        traffic: counts of states and commands; the SDK leaves out what is damaged, late or lost, and does not tell.
    """

    sent_at = math.nan

    def __init__(self, sdk: Any = None, address: tuple[str, int] = (ROBOT, ROBOT_PORT)) -> None:
        """Open the way; ``sdk`` stands for the module in tests.

        Raises:
            RobotError: if the binding is not there.
        """
        self._sdk = _module() if sdk is None else sdk
        self._udp = self._sdk.UDP(LOW_LEVEL, LOCAL_PORT, *address)
        self._guard = self._sdk.Safety(self._sdk.LeggedType.Go1)
        self._command, self._state = self._sdk.LowCmd(), self._sdk.LowState()
        self._udp.InitCmdData(self._command)
        self._arrived: deque[LowState] = deque(maxlen=1000)
        self._wanted: tuple[LowCmd, float] | None = None
        self._tick: int | None = None
        self._health: Health | None = None
        self._begun, self.traffic = False, Traffic(complete=False)
        self._failure: BaseException | None = None
        self._going = True
        self._thread = threading.Thread(target=self._pump, name="go1", daemon=True)
        self._thread.start()

    def receive(self) -> Sequence[LowState]:
        """Return the states that have arrived since the last call, oldest first.

        Raises:
            RobotError: if the exchange with the robot has ended.
        """
        if self._failure is not None:
            raise RobotError(f"the SDK failed: {type(self._failure).__name__}: {self._failure}")
        states = []
        while self._arrived:
            states.append(self._arrived.popleft())
        return states

    @property
    def tick(self) -> int | None:
        """The tick of the newest state; None before the first."""
        return self._tick

    @property
    def health(self) -> Health | None:
        """What the newest state before the first command had beside the readings; None before the first state."""
        return self._health

    def send(self, command: LowCmd) -> None:
        """Hand over a command; it goes out within 2 ms, and again every 2 ms."""
        self._wanted = (command, time.perf_counter())

    def repeat(self) -> None:
        """Do nothing: the thread repeats the command."""

    def rehearse(self, command: LowCmd) -> None:
        """Do nothing: the thread sends."""

    def close(self) -> None:
        """End the exchange; once the drives were commanded, after a last command to brake."""
        self._going = False
        self._thread.join(1.0)

    def _pump(self) -> None:
        due = time.perf_counter()
        try:
            while self._going:
                self.exchange(time.perf_counter())
                due = max(due + PERIOD, time.perf_counter() - PERIOD)
                time.sleep(max(due - time.perf_counter(), 0.0))
            self._wanted = None
            self.exchange(time.perf_counter())
        except BaseException as error:
            self._failure = error

    def exchange(self, now: float) -> None:
        """Take a state if there is a new one, and send what is wanted; ``now`` in s."""
        self._udp.Recv()
        self._udp.GetRecv(self._state)
        tick = int(self._state.tick)
        if tick != self._tick and tick != 0:  # zero until something has come
            self._tick = tick
            if not self._begun:  # for the check, before the first command: reading it takes long
                self._health = _health(self._state)
            self.traffic.received += 1
            self._arrived.append(_read(self._state, now))
        self._begun = self._begun or self._wanted is not None
        if self._begun:  # before that an empty command is sent, as in the SDK's example: the robot answers only then
            self._fill(now)
        self._udp.SetSend(self._command)
        self._udp.Send()
        self.traffic.sent += 1

    def _fill(self, now: float) -> None:
        """Write what is wanted into the SDK's command; braking if nothing is, or not any more."""
        wanted = self._wanted
        stale = wanted is None or now - wanted[1] > SILENCE
        for k in range(JOINTS):
            motor = self._command.motorCmd[k]
            motor.mode, motor.dq, motor.tau = SERVO, 0.0, 0.0
            if stale or wanted is None:
                motor.q, motor.Kp, motor.Kd = float(self._state.motorState[k].q), 0.0, DEFAULT_KD
            else:
                command = wanted[0]
                motor.q, motor.Kp, motor.Kd = (
                    float(part[k]) for part in (command.joint_target, command.kp, command.kd)
                )
                motor.tau = 0.0 if command.feedforward is None else float(command.feedforward[k])
        self._guard.PositionLimit(self._command)
        self._guard.PowerProtect(self._command, self._state, POWER_LEVEL)


def _read(state: Any, now: float) -> LowState:
    """Return the SDK's state; its tick is no clock (its unit differs between versions)."""
    motors = [state.motorState[k] for k in range(JOINTS)]
    return LowState(
        t=now,
        joint_pos=np.array([motor.q for motor in motors]),
        joint_vel=np.array([motor.dq for motor in motors]),
        joint_torque=np.array([motor.tauEst for motor in motors]),
        imu_quat=np.array(state.imu.quaternion, dtype=float),
        imu_gyro=np.array(state.imu.gyroscope, dtype=float),
        imu_acc=np.array(state.imu.accelerometer, dtype=float),
        foot_force=np.array([float(state.footForce[k]) for k in range(4)]),
    )


def _health(state: Any) -> Health:
    """Return what the SDK's state has beside the readings."""
    motors = [state.motorState[k] for k in range(JOINTS)]
    return Health(
        charge=int(state.bms.SOC),
        current=1e-3 * int(state.bms.current),
        cell_voltage=tuple(1e-3 * float(volts) for volts in state.bms.cell_vol),  # mV: the SDK has scaled them
        motor_temperature=tuple(int(motor.temperature) for motor in motors),
        imu_temperature=int(state.imu.temperature),
        acceleration=tuple(float(motor.ddq) for motor in motors),
    )


def _module() -> Any:
    for name in MODULES:
        with contextlib.suppress(ImportError):
            return importlib.import_module(name)
    raise RobotError(
        f"robot=go1_sdk: no module {MODULES[0]!r}. It is the Python binding of the vendor's unitree_legged_sdk 3.8 "
        "(branch for the Go1): build it on this computer and put its folder into PYTHONPATH, or install "
        "unitree-legged-sdk==3.8.20231105 with --no-deps (Python 3.11, x86-64). robot=go1 needs none of it"
    )
