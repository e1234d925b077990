"""What every registered term promises, by the checks that users call for theirs (``go1exp.extend.testing``)."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

import go1exp.extend  # noqa: F401  (registers every term)
from go1exp.base.tensors.memory import Memory
from go1exp.config.schema.registry import Entry, foreign, groups, members
from go1exp.extend.testing import check_term, check_terms
from go1exp.logs.recording import joint_channels
from go1exp.mdp.types import Snapshot, TermSetup
from go1exp.robot import JOINTS, NOMINAL_STANCE

EVERY = [entry for group in groups() for entry in members(group).values() if entry not in foreign()]

NULL: dict[str, dict[str, Any]] = {
    "foot_friction": {"range": (1.0, 1.0), "operation": "scale"},
    "ground_stiffness": {"range": (0.02, 0.02)},
    "center_of_mass": {"range": (0.0, 0.0)},
    "link_mass": {"range": (1.0, 1.0)},
}
"""Of model terms: at these the robot stays the nominal one; of state terms: a range of zero."""

ROUNDS = ("net",)
"""Terms that multiply matrices."""


@pytest.fixture(scope="session")
def needs(make_net: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """What a term cannot be built without."""
    targets = tmp_path_factory.mktemp("targets") / "targets.csv"
    stance = ",".join(map(str, NOMINAL_STANCE))
    header = ",".join(["t", *joint_channels("q_target", JOINTS)])
    targets.write_text(f"{header}\n0.0,{stance}\n1.0,{stance}\n")
    files = {"net": {"file": str(make_net(bias=0.0, torque=300.0))}, "playback": {"file": str(targets)}}
    return {"delay": {"drive": {"term": "pd"}}, **files}


@pytest.mark.parametrize("entry", EVERY, ids=[f"{e.group}.{e.name}" for e in EVERY])
def test_a_registered_term_keeps_what_its_group_promises(entry: Entry, needs: dict[str, dict[str, Any]]) -> None:
    null = NULL.get(entry.name) or ({"range": (0.0, 0.0)} if entry.traits.get("kind") == "state" else None)
    traits = {**entry.traits, **({"null": null} if null and entry.group == "rand" else {})}
    tried = Entry(entry.group, entry.name, entry.target, traits)
    check_term(tried, needs.get(entry.name), exact=entry.name not in ROUNDS)


def test_a_net_whose_commands_are_delayed_keeps_what_actuators_promise(needs: dict[str, dict[str, Any]]) -> None:
    check_term(members("actuator")["delay"], {"drive": {"term": "net", **needs["net"]}})


# ---------------------------------------------------------------------- the checks find what they are for


def function(group: str, target: Callable[..., Any], **traits: Any) -> Entry:
    target.__doc__ = "Does something."
    return Entry(group, "mine", target, traits)


def refused(entry: Entry, **parameters: Any) -> str:
    with pytest.raises(AssertionError) as error:
        check_term(entry, parameters)
    text = str(error.value)
    assert text.startswith(f"{entry.group}.mine (")
    assert Path(__file__).name in text
    return text.split("): ")[1]


def test_a_function_of_a_snapshot_that_breaks_a_promise_is_named() -> None:
    def columns(s: Snapshot) -> Tensor:
        return s.action

    def double(s: Snapshot) -> Tensor:
        return s.action.sum(-1).double()

    def infinite(s: Snapshot) -> Tensor:
        return s.action.sum(-1) / 0.0

    def crowd(s: Snapshot) -> Tensor:
        return s.action.sum(-1) - s.action.sum(-1).mean()

    def writes(s: Snapshot) -> Tensor:
        s.action.mul_(2.0)
        return s.action.sum(-1)

    assert refused(function("reward", columns)) == "it must be (N)"
    assert "it must be torch.float32, and is torch.float64" in refused(function("reward", double))
    assert refused(function("reward", infinite)) == "it must be finite"
    assert refused(function("reward", crowd)) == "a robot must get the same alone and in a batch"
    assert refused(function("reward", writes)) == "it must leave the Snapshot as it is"
    assert refused(function("observation", columns, size=3)) == "it must be (N, 3)"
    assert "how wide" in refused(function("observation", columns))
    assert "torch.bool" in refused(function("termination", lambda s: s.action.sum(-1)))


class Forgetful(Memory):
    """Does something."""

    memory = ("sum",)

    def __init__(self, setup: TermSetup) -> None:
        self.sum = setup.zeros()

    def __call__(self, s: Snapshot) -> Tensor:
        self.sum += s.action.sum(-1)
        return self.sum

    def reset(self, mask: Tensor) -> None:
        self.sum.masked_fill_(mask, 0.0)


def test_a_class_that_breaks_a_promise_is_named() -> None:
    class Deaf(Forgetful):
        """Does something."""

        def reset(self, mask: Tensor) -> None:
            pass

    class Overzealous(Forgetful):
        """Does something."""

        def reset(self, mask: Tensor) -> None:
            self.sum.zero_()

    class Assigns(Forgetful):
        """Does something."""

        def __call__(self, s: Snapshot) -> Tensor:
            self.sum = self.sum + s.action.sum(-1)
            return self.sum

    class Hides(Forgetful):
        """Does something."""

        memory = ("sum",)

        def __init__(self, setup: TermSetup) -> None:
            super().__init__(setup)
            self.hidden = setup.zeros()

        def __call__(self, s: Snapshot) -> Tensor:
            self.hidden += s.action.sum(-1)
            return self.sum + self.hidden

    check_term(Entry("reward", "mine", Forgetful))
    assert refused(Entry("reward", "mine", Deaf)) == "reset must forget the masked rows"
    assert refused(Entry("reward", "mine", Overzealous)) == "reset must touch masked rows only"
    assert "in place" in refused(Entry("reward", "mine", Assigns))
    assert "continue from its saved state" in refused(Entry("reward", "mine", Hides))


def test_randomisations_actuators_and_excitations_that_break_a_promise_are_named() -> None:
    def nothing(model: Any, stream: Any, mask: Tensor) -> None:
        model.field("body_mass")[:] *= 1.1

    def strong(setup: Any) -> Any:
        made = members("actuator")["pd"].target(setup, kp=1000.0)
        made._limit = made._limit * math.inf
        return made

    def far(t: Any, centre: Any, limits: Any, rng: Any) -> Any:
        motion = members("excitation")["chirp"].target(t, centre, limits, rng)
        motion.target[:] += 3.0
        return motion

    assert "masked rows" in refused(function("rand", nothing, kind="model", fields=("body_mass",)))
    assert "torques must stay within" in refused(function("actuator", strong))
    assert refused(function("excitation", far)) == "it must stay within the joints' limits"


def test_all_that_is_broken_is_told_at_once() -> None:
    wrong = [function("reward", lambda s: s.action), function("termination", lambda s: s.nothing)]
    with pytest.raises(AssertionError) as error:
        check_terms(wrong)
    first, second = str(error.value).splitlines()
    assert "it must be (N)" in first
    assert second == "termination.mine: AttributeError: 'Snapshot' object has no attribute 'nothing'"
