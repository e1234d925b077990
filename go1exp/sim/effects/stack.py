"""All effects of a batch of robots, in the order in which they act."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from go1exp.config.schema.joint_values import spread
from go1exp.config.schema.registry import Term
from go1exp.robot.actuators import ActuatorSetup, ModelFields
from go1exp.sim.actuator.motors import Actuator, HasGains
from go1exp.sim.effects.base import Effect, Gears, Measured
from go1exp.sim.effects.gears import TwoMass
from go1exp.sim.physics.backend import PhysicsBackend

HOOKS = (
    *("on_target", "on_feedforward", "on_encoder", "on_error", "on_gains", "on_actuator", "on_report"),
    *("on_transmission", "on_gears", "on_joint", "on_friction", "on_load", "on_base"),
)


class _Fields:
    """Model fields under construction: the compiled values, changed by one effect after the other."""

    def __init__(self, model: PhysicsBackend, names: Sequence[str]) -> None:
        self._model, self.ids, n = model, model.ids, model.num_envs
        compiled = {name: model.compiled(name) for name in names}
        self.values = {name: value.unsqueeze(0).repeat(n, *[1] * value.dim()) for name, value in compiled.items()}

    def field(self, name: str) -> Tensor:
        return self.values[name]

    def nominal(self, name: str) -> Tensor:
        return self._model.compiled(name).unsqueeze(0) if name in self.values else self._model.nominal(name)


class EffectStack:
    """The configured effects, called hook by hook; with none configured every hook returns what it was given.

    Attributes:
        effects: by their keys in the configuration.
        rotors: of gears that yield; None if no effect makes them.
    """

    def __init__(self, terms: Sequence[Term], setup: ActuatorSetup) -> None:
        """Build the effects of ``terms``."""
        self._setup = setup
        self.effects: dict[str, Effect] = {t.key: t(setup) for t in terms}
        self._spreads = {t.key: dict(t.slots.get("spread", {})) for t in terms}
        self._given = {t.key: t.parameters for t in terms}
        ranked = sorted(self.effects.values(), key=lambda e: e.order)
        self._acting = {
            hook: [e for e in ranked if getattr(type(e), hook) is not getattr(Effect, hook)]
            for hook in (*HOOKS, "on_sensor", "edit_model")
        }
        self.fields = tuple(dict.fromkeys(name for e in ranked for name in e.fields))
        self.rotors = TwoMass(setup) if self.acts("on_gears") else None

    def acts(self, hook: str) -> bool:
        """Return whether any effect overrides ``hook``."""
        return bool(self._acting[hook])

    # ------------------------------------------------------------------ the robots

    def draw(self) -> None:
        """Draw each environment's values within the configured spreads, about the configured values."""
        for key, widths in self._spreads.items():
            effect = self.effects[key]
            for p in effect.params:
                if p.name not in widths:
                    continue
                live: Tensor = getattr(effect, p.name)
                given = self._given[key].get(p.name, p.null)
                named = torch.ones_like(live[0], dtype=torch.bool)
                centre = torch.full_like(live[0], p.null)
                if p.per == "joint":
                    values = torch.as_tensor(spread(given, self._setup.joints), dtype=live.dtype, device=live.device)
                    named, centre = ~values.isnan(), values.nan_to_num(nan=p.null)
                else:
                    centre += float(given) - p.null
                unit = self._setup.random.stream(f"effect.{key}.{p.name}").uniform(live.shape[1], low=-1.0)
                drawn = (centre + widths[p.name] * unit.to(live.dtype)).clamp(p.smallest, p.high)
                live.copy_(torch.where(named, drawn, centre))

    def model_values(self, model: PhysicsBackend) -> dict[str, Tensor]:
        """Return the fields (N, ...) of a model with all effects in them, from those without any."""
        fields: ModelFields = _Fields(model, self.fields)
        for effect in self._acting["edit_model"]:
            effect.edit_model(fields)
        return fields.values  # type: ignore[attr-defined]

    def prepare(self) -> None:
        """Let every effect work out what follows from its values."""
        for effect in self.effects.values():
            effect.prepare()

    def set_gains(self, actuator: Actuator, kp: Tensor, kd: Tensor) -> None:
        """Give the actuator the gains that it really has, from those of its configuration."""
        if self._acting["on_gains"]:
            assert isinstance(actuator, HasGains)  # the configuration has been checked
            for effect in self._acting["on_gains"]:
                kp, kd = effect.on_gains(kp, kd)
            actuator.kp.copy_(kp)
            actuator.kd.copy_(kd)

    # ------------------------------------------------------------------ the step

    def through(self, hook: str, value: Tensor, *others: Tensor) -> Tensor:
        """Return ``value`` after this hook of one effect after the other; the hooks are those of ``Effect``."""
        for effect in self._acting[hook]:
            value = getattr(effect, hook)(value, *others)
        return value

    def on_encoder(self, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        """Return what the actuators' encoders read."""
        if self.rotors:
            q, qd = self.rotors.motor(q, qd)
        for effect in self._acting["on_encoder"]:
            q, qd = effect.on_encoder(q, qd)
        return q, qd

    def gears(self) -> Gears:
        """Return how the gears yield."""
        gears = Gears(self._setup.zeros(), self._setup.zeros(), self._setup.zeros())
        for effect in self._acting["on_gears"]:
            gears = effect.on_gears(gears)
        return gears

    def on_joint(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the sum of all torques on the joints that are not the actuators'."""
        return sum((e.on_joint(q, qd) for e in self._acting["on_joint"]), start=torch.zeros_like(q))

    def measure(self, true: Measured) -> Measured:
        """Return what the robots' sensors say; the joint readings come from ``on_encoder``."""
        q, qd = self.on_encoder(true.joint_pos, true.joint_vel)
        readings = Measured(q, qd, true.gravity, true.gyro, true.acc, true.quat)
        for effect in self._acting["on_sensor"]:
            readings = effect.on_sensor(readings)
        return readings

    @property
    def senses(self) -> bool:
        """Whether any effect changes what the sensors or the actuators say."""
        hooks = ("on_sensor", "on_encoder", "on_report")
        return any(self.acts(hook) for hook in hooks) or self.rotors is not None

    # ------------------------------------------------------------------ state

    def reset(self, mask: Tensor) -> None:
        """Begin new episodes in the rows of ``mask`` (N,)."""
        for effect in self.effects.values():
            effect.reset(mask)

    def state_dict(self) -> dict[str, Any]:
        """Return the values and the memories of all effects."""
        return {key: effect.state_dict() for key, effect in self.effects.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``."""
        for key, effect in self.effects.items():
            effect.load_state_dict(state[key])
        self.prepare()
