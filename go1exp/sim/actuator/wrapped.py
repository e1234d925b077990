"""An actuator inside an actuator, as a configuration writes it."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator
from pydantic_core import PydanticCustomError

from go1exp.config.schema.registry import bind, members
from go1exp.robot.actuators import ActuatorSetup


def _checked(settings: dict[str, Any]) -> dict[str, Any]:
    """Check the term in ``settings`` as the registry does; return it with its defaults filled in."""
    if "term" not in settings:
        problems = ["drive.term: required, but not given"]
    else:
        term, problems = bind("actuator", str(settings["term"]), settings, "drive")
        if term is not None:
            return {"term": term.entry.name, **term.parameters}
    raise PydanticCustomError("problems", "{lines}", {"lines": "\n".join(problems)})


InnerActuator = Annotated[dict[str, Any], AfterValidator(_checked)]
"""``{term: pd, kp: 20.0, ...}``: type of a parameter called ``drive``."""


def build(setup: ActuatorSetup, drive: dict[str, Any]) -> Any:
    """Return the actuator that ``drive`` describes."""
    parameters = {k: v for k, v in drive.items() if k != "term"}
    return members("actuator")[drive["term"]].target(setup, **parameters)
