"""Tolerances as data: how far each parameter of a robot's model may be off before anyone would care.

Effects declare them; a robot that is known worse or better replaces some. They belong to the robot that is compared,
are handed on from there, and are written down with what was found.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from go1exp.config.schema.physics import ContactConfig
from go1exp.config.schema.registry import members, unknown_name
from go1exp.sim.effects.base import Effect, Param

Key = tuple[str, str]
"""Effect and parameter."""


def effect_class(name: str) -> type[Effect]:
    """Return the class of a registered effect."""
    return members("effect")[name].target  # type: ignore[return-value]


def declared(key: Key) -> Param:
    """Return the declaration of a parameter."""
    return next(p for p in effect_class(key[0]).params if p.name == key[1])


def sizes(effect: str) -> tuple[Key, ...]:
    """Return the parameters of an effect that have a tolerance; the others are shapes."""
    return tuple((effect, p.name) for p in effect_class(effect).params if math.isfinite(p.tolerance))


@dataclass(frozen=True)
class Tolerances:
    """All parameters of all effects as one robot has them: about which value, and how far that may be off.

    Attributes:
        replaced: (effect, parameter) -> tolerance in the place of the declared one, in the parameter's unit.
        contact: of the robot's feet, whose values are the null ones of what acts on it; None of a robot in the air.
    """

    replaced: Mapping[Key, float] = field(default_factory=dict, hash=False)
    contact: ContactConfig | None = None

    @staticmethod
    def from_effects(by_effect: Mapping[str, Mapping[str, float]], contact: ContactConfig | None = None) -> Tolerances:
        """Return those of a configuration or a file: effect -> parameter -> tolerance."""
        return Tolerances(
            {(effect, name): value for effect, params in by_effect.items() for name, value in params.items()}, contact
        )

    def on(self, contact: ContactConfig) -> Tolerances:
        """Return the tolerances of the same robot standing, with this contact of its feet."""
        return dataclasses.replace(self, contact=contact)

    def param(self, key: Key) -> Param:
        """Return the declaration of a parameter with the null value and the tolerance that count."""
        param = declared(key)
        tolerance = self.replaced.get(key, param.tolerance)
        if tolerance != param.tolerance:
            param = dataclasses.replace(param, tolerance=tolerance)
        value = effect_class(key[0]).nominal(self.contact).get(key[1]) if self.contact else None
        if value is not None:
            param = dataclasses.replace(param, null=value, low=min(param.smallest, value), least=None)
        return param

    def by_effect(self) -> dict[str, dict[str, float]]:
        """Return every finite tolerance that counts, the declared ones too: effect -> parameter -> tolerance."""
        return {
            effect: {name: self.param((effect, name)).tolerance for _, name in sizes(effect)}
            for effect in sorted(members("effect"))
        }


DECLARED = Tolerances()
"""Those that the effects declare."""


def problems(by_effect: Mapping[str, Mapping[str, float]], path: str) -> list[str]:
    """Return what is wrong with a configuration of tolerances, one line each with its key path.

    Names must be known, and no tolerance may be wider than the range in which a parameter is searched.
    """
    lines = []
    for effect, params in by_effect.items():
        if effect not in members("effect"):
            lines.append(unknown_name(f"{path}.{effect}", effect, members("effect"), "effect"))
            continue
        known = {p.name: p for p in effect_class(effect).params}
        for name, tolerance in params.items():
            if name not in known:
                lines.append(unknown_name(f"{path}.{effect}.{name}", name, known, "parameter"))
            elif not math.isfinite(known[name].tolerance):
                lines.append(f"{path}.{effect}.{name}: is a shape, which has no tolerance")
            elif tolerance > (most := max(known[name].high - known[name].null, known[name].null - known[name].low)):
                p = known[name]
                what = f"is wider than what is searched, {p.low:g} to {p.high:g} {p.unit.strip('-')}".rstrip()
                lines.append(f"{path}.{effect}.{name} = {tolerance:g}: {what}; at most {most:g}")
    return lines
