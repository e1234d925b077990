"""Contact of the feet with the ground: what the group's choices do, and what randomisations make of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest

from go1exp import robot
from go1exp.config.compose import compose
from go1exp.config.schema.physics import MUJOCO_CONTACT
from go1exp.config.schema.registry import ConfigError
from go1exp.sim.env.core import Go1Core
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.task import TaskConfig, parse_task, parse_train

STILL = ("rand=none", "event=none", "termination=none", "command=forward")


@pytest.mark.parametrize(
    ("choice", "time_constant", "cone", "impratio"),
    [("soft", 0.02, "PYRAMIDAL", 1.0), ("stiff", 0.005, "PYRAMIDAL", 1.0), ("elliptic", 0.005, "ELLIPTIC", 10.0)],
)
def test_a_choice_is_what_is_simulated(
    choice: str, time_constant: float, cone: str, impratio: float, make_core: Callable[..., Go1Core]
) -> None:
    backend = make_core(f"contact={choice}", num_envs=1).backend
    assert isinstance(backend, MujocoCpu)
    option, feet = backend.model.opt, [backend.model.geom(f"{leg}_foot").id for leg in robot.LEGS]
    np.testing.assert_allclose(backend.model.geom_solref[feet], [[time_constant, 1.0]] * 4)
    assert option.cone == getattr(mujoco.mjtCone, f"mjCONE_{cone}")
    assert option.impratio == impratio


def test_a_run_of_an_older_version_had_mujocos_own_contact() -> None:
    container = compose("train", ["contact=stiff"])
    del container["contact"]
    assert parse_train(container).task.contact == MUJOCO_CONTACT
    assert parse_train(compose("train", ["contact=soft"])).task.contact == MUJOCO_CONTACT


def feet_of(core: Go1Core) -> np.ndarray:
    """Return time constant and damping ratio (N, 4, 2)."""
    ids = core.backend.ids("geom", tuple(f"{leg}_foot" for leg in robot.LEGS))
    return np.asarray(core.backend.field("geom_solref")[:, ids])


def test_a_restitution_leaves_the_spring_and_a_stiffness_the_damping_ratio(make_core: Callable[..., Go1Core]) -> None:
    def drawn(rand: str) -> np.ndarray:
        core = make_core(*STILL, "contact=stiff", f"+rand={rand}", num_envs=6)
        core.reset()
        return feet_of(core)

    bouncing = drawn("{foot_restitution: {range: [0.2, 0.5]}}")
    np.testing.assert_allclose(bouncing.prod(-1), 0.005, rtol=1e-6)
    assert len(np.unique(bouncing[..., 1])) == 24
    ground = drawn("{ground_stiffness: {range: [0.004, 0.02]}}")
    assert (ground[..., 1] == 1.0).all()
    assert (ground[:, :1, 0] == ground[..., 0]).all()  # one ground under four feet
    assert len(np.unique(ground[..., 0])) == 6
    both = drawn("{ground_stiffness: {range: [0.004, 0.02], restitution: [0.2, 0.5]}}")
    np.testing.assert_allclose(both.prod(-1), ground[..., 0], rtol=1e-6)  # the same draw
    assert (both[..., 1] < 1.0).all()


def test_two_terms_that_set_the_same_are_refused_by_name() -> None:
    container: dict[str, Any] = compose("train", ["rand=text", "+rand.ground_stiffness={}"])
    with pytest.raises(ConfigError) as error:
        parse_task(container)
    assert error.value.problems == [
        "rand.ground_stiffness: sets the contact of the feet, as rand.foot_restitution does; use one of the two"
    ]


def test_a_policy_is_judged_on_the_contact_that_is_asked_for(make_task: Callable[..., TaskConfig]) -> None:
    from go1exp.cli import subjects

    other, rest = subjects.split_robot(
        {"contact": {"time_constant": 0.01, "cone": "elliptic", "impratio": 5.0}, "run": 1}
    )
    assert subjects.with_robot(make_task(), other).contact.time_constant == 0.01
    assert subjects.robot_as_data(other) == {"contact": {"time_constant": 0.01, "cone": "elliptic", "impratio": 5.0}}
    assert rest == {"run": 1}
    with pytest.raises(ConfigError, match=r"contact\.cone"):
        subjects.split_robot({"contact": {"time_constant": 0.01, "cone": "round", "impratio": 5.0}})
