"""What a foot on the ground is like."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from go1exp.config.schema.registry import STRICT, as_json


@dataclass(frozen=True)
class ContactConfig:
    """Contact of the feet with the ground (docs/contact.md).

    Attributes:
        time_constant: of the spring-damper under each foot, s: a foot sinks as its square. At least two physics steps.
        cone: friction cone: ``elliptic``, the same in every direction, or ``pyramidal``, weaker by 0.71 on diagonals.
        impratio: how much harder friction is than the normal force; more means less creep of a loaded foot.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    time_constant: Annotated[float, Field(ge=0.002, le=0.1)]
    cone: Literal["pyramidal", "elliptic"]
    impratio: Annotated[float, Field(ge=1, le=100)]


MUJOCO_CONTACT = ContactConfig(time_constant=0.02, cone="pyramidal", impratio=1.0)
"""MuJoCo's own: a mattress. Runs of go1exp 0.1 were trained on it."""


def read_contact(given: Any) -> ContactConfig | None:
    """Return a contact from plain data; None if that is none."""
    try:
        return TypeAdapter(ContactConfig).validate_json(as_json(given))
    except ValidationError:
        return None


def contact_text(contact: ContactConfig) -> str:
    """Return a contact in words: ``5 ms, pyramidal, impratio 1``."""
    return f"{1e3 * contact.time_constant:g} ms, {contact.cone}, impratio {contact.impratio:g}"
