"""Commands over time, gain and lag of signals whose gain and lag are known, impulses against momentum."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from go1exp.evaluate.protocol.plan import Impulses, Kicker, heading
from go1exp.evaluate.protocol.signals import Constant, Sine, Steps, phasors, response

PERIOD = 3.5


def test_steps_and_rests_begin_when_they_say() -> None:
    t = np.arange(6) * 0.5
    steps = Steps(velocities=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), hold=1.0)
    assert steps.at(t)[:, 0].tolist() == [1, 1, 0, 0, 0, 0]
    assert Constant(velocity=(2.0, 0.0, 1.0), rest=1.0).at(t)[:, 2].tolist() == [0, 0, 1, 1, 1, 1]


@pytest.mark.parametrize("dt", [0.02, 0.013])
@pytest.mark.parametrize(("gain", "lag"), [(1.0, 0.0), (0.8, 0.12), (1.1, -0.05)])
def test_known_gain_and_lag_are_found(dt: float, gain: float, lag: float) -> None:
    """Also under the gait's own motion, an offset, and with a period that is no whole number of samples."""
    t = np.arange(round(35.0 / dt)) * dt
    command = Sine(amplitude=(1.0, 0.5, 1.0), period=PERIOD).at(t)
    gait = 0.2 * np.sin(2 * np.pi * 2.8 * t)[:, None]
    answer = gain * Sine(amplitude=(1.0, 0.5, 1.0), period=PERIOD).at(t - lag) + gait + 0.1
    answer[t < PERIOD] = 7.0  # the first period does not count
    found_gain, found_lag, coherence = response(answer, command, t, PERIOD)
    np.testing.assert_allclose(found_gain, gain, atol=6e-3)
    np.testing.assert_allclose(found_lag, lag, atol=6e-3)
    assert (coherence > 0.999).all()


def test_periods_that_are_answered_differently_have_little_coherence() -> None:
    t = np.arange(8750) * 0.02
    command = Sine(amplitude=(1.0, 1.0, 1.0), period=PERIOD).at(t)
    rng = np.random.default_rng(0)
    _, _, coherence = response(rng.normal(size=command.shape), command, t, PERIOD)
    assert (coherence < 0.2).all()


def test_without_a_second_period_there_is_no_answer() -> None:
    t = np.arange(100) * 0.02
    command = Sine(amplitude=(1.0, 1.0, 1.0), period=PERIOD).at(t)
    assert np.isnan(response(command, command, t, PERIOD)[0]).all()
    assert len(phasors(command, t, PERIOD)) == 0


# ---------------------------------------------------------------------- kicks


class Free:
    """A free-floating trunk as an engine of two robots, without gravity."""

    MODEL = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body><freejoint/>
    <geom type="box" size=".2 .1 .05" mass="12.5"/></body></worldbody></mujoco>"""

    def __init__(self) -> None:
        model = mujoco.MjModel.from_xml_string(self.MODEL)
        self.model, self.data = model, [mujoco.MjData(model) for _ in range(2)]
        self.qpos = torch.zeros(2, 7, dtype=torch.float64)
        self.qvel = torch.zeros(2, 6, dtype=torch.float64)
        self._applied = torch.zeros(2, 6, dtype=torch.float64)
        self.qpos[:, 3] = 1.0

    def applied(self) -> torch.Tensor:
        return self._applied

    def step(self, torque: torch.Tensor) -> None:
        for k, data in enumerate(self.data):
            data.qpos[:], data.qvel[:] = self.qpos[k].numpy(), self.qvel[k].numpy()
            data.qfrc_applied[:] = self._applied[k].numpy()
            mujoco.mj_step(self.model, data)
            self.qpos[k], self.qvel[k] = torch.from_numpy(data.qpos.copy()), torch.from_numpy(data.qvel.copy())


def kicked(backend: Free, impulses: Impulses, seconds: float) -> None:
    kicker = Kicker(backend, 0.002, impulses)
    for _ in range(round(seconds / 0.002)):
        backend.step(torch.zeros(2, 12))
    assert kicker.time == pytest.approx(seconds)


def test_an_impulse_is_the_momentum_that_it_gives() -> None:
    """Of a trunk that floats: m dv is the impulse, in the direction from its heading; others' forces stay."""
    backend = Free()
    backend.qpos[1, 3:7] = torch.tensor([np.cos(0.25), 0.0, 0.0, np.sin(0.25)])  # heading 0.5 rad
    assert heading(backend.qpos[:, 3:7]).tolist() == pytest.approx([0.0, 0.5])
    impulses = Impulses(
        start=np.array([[0.1, 0.4], [0.1, np.nan]]),
        size=np.array([[12.7, 6.4], [19.1, 5.0]]),
        direction=np.array([[np.pi / 2, np.pi / 2], [0.0, 0.0]]),
        duration=0.1,
    )
    kicked(backend, impulses, 1.0)
    gained = 12.5 * backend.qvel[:, :3].numpy()
    np.testing.assert_allclose(gained[0], [0.0, 12.7 + 6.4, 0.0], atol=1e-9)
    np.testing.assert_allclose(gained[1], [19.1 * np.cos(0.5), 19.1 * np.sin(0.5), 0.0], atol=1e-9)
    assert (backend.applied() == 0).all()


def test_a_kick_beside_the_centre_turns_the_trunk() -> None:
    """I dw is arm x impulse."""
    backend = Free()
    impulses = Impulses(np.full((2, 1), 0.0), np.full((2, 1), 3.0), np.full((2, 1), np.pi / 2), 0.002, (0.1, 0.0, 0.0))
    kicked(backend, impulses, 0.01)
    spin = backend.qvel[:, 5].numpy() * backend.model.body_inertia[1].max()
    np.testing.assert_allclose(spin, 0.1 * 3.0, rtol=1e-3)


def test_forces_of_others_are_kept_and_added_to() -> None:
    backend = Free()
    backend.applied()[:, 2] = 1.0
    impulses = Impulses(np.zeros((2, 1)), np.full((2, 1), 3.0), np.zeros((2, 1)), 0.1)
    kicked(backend, impulses, 0.2)
    assert backend.applied()[:, 2].tolist() == [1.0, 1.0]
    np.testing.assert_allclose(12.5 * backend.qvel[:, :3].numpy(), [[3.0, 0.0, 0.2]] * 2, atol=1e-9)
