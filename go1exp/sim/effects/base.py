"""What a physical effect is: parameters, a law, the places where it acts, and how it is looked for in recordings.

One effect is one class. Training, evaluation and the gap workflow use the same object; at its null values
the robot moves as without it, bit for bit. The gap workflow knows no effect by name: each carries an
:class:`Identification`, whose defaults suit an effect of the joints that any motion shows.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field

from go1exp.base.tensors.memory import Memory
from go1exp.config.schema.joint_values import JointValues, each_within
from go1exp.config.schema.physics import ContactConfig
from go1exp.robot.actuators import ActuatorSetup, ModelFields

if TYPE_CHECKING:
    from torch import Tensor

MEAN_ANGLE, LEAST_ANGLE, LARGEST_ANGLE = math.nan, -math.inf, math.inf
"""Stand in ``Identification.shapes`` for the angle at which each joint is on average, and for the least and the largest
that it reaches, rad."""

LAST = 100
"""Rank of an effect that does not choose one."""

TWO_KD = "record torque_off swings, or two values of kd (gains=[[20,0.5],[20,1.0]])"
TWO_ATTITUDES = "record two attitudes of the trunk (hang=[[0,0],[0,0.5]])"
SHARP_EDGES = "record steps, whose edges tell a delay from a lag"
TWO_GAIN_SETS = "record slow_ramps and a chirp at two gain sets"


@dataclass(frozen=True)
class Periodic:
    """Parameters of a torque that is periodic in the angle: amplitude sin(count q + phase).

    For one ``count`` it is linear in amplitude cos(phase) and amplitude sin(phase), so these two are fitted; ``count``
    is tried value by value.

    Attributes:
        amplitude: name of the parameter with a tolerance.
        phase: name of the phase, rad.
        count: name of the number of periods per turn.
        counts: values of ``count`` to try.
    """

    amplitude: str
    phase: str
    count: str
    counts: tuple[float, ...]


@dataclass(frozen=True)
class Identification:
    """How an effect is looked for in recordings.

    Attributes:
        nominal: every model has a value for it, if only the null one, so it may move within its tolerance from the
            start (the tolerance box). An effect that is not nominal must be missing beyond doubt before it is used.
        rank: place among the nominal effects, smaller first, then in the order of registration. Resampling draws its
            random numbers in this order, so a change of it changes intervals within their own uncertainty.
        needs_ground: it acts on the trunk or on the feet; a robot whose trunk is held does not feel it.
        needs_stand: it acts on what holds a trunk; a robot whose trunk is free does not feel it.
        common: its parameters have one value for all joints at which it is. For effects that few joints ever show.
        weighs_on_legs: one such error, equal at all joints, moves the legs of a standing robot as a change of weight
            does; an effect of the trunk must explain recordings better than it.
        of_gains: it acts as a change of the controller's gains; where a model guesses those, no effect of this kind is
            identifiable against the others together.
        uniform: one fault may give all joints the same value of it (a low battery, a wrong pose at calibration). It is
            tried as the one cause of all model errors of a standing robot, with one value.
        levels: changes from null, by parameter, in its unit, at which it is probed; each may become the start of a fit.
            For effects with a threshold, or far from linear. Empty: twice the tolerance of each parameter.
        limits_torque: parameter that is a limit of the torque as a share of the peak; it is also probed part by part,
            at shares of the largest torque that a part was asked for, since one above does nothing. Empty for none.
        shapes: values of its shape parameters with which it is tried. Empty: their null values.
        free_shapes: shape parameters that a full fit may change.
        laws: values of further shape parameters, each of which makes another law of the effect; the law that screening
            finds best is fitted, and its values are held. Empty: their null values.
        periodic: its parameters, if it is a torque that is periodic in the angle.
        simpler: effect that explains nearly the same with fewer numbers, and is taken where it does as well.
        simpler_if_equal: two parameters that make it the simpler effect where they are equal.
        excitation: motion that shows it best (``go1exp list excitations``).
        confounded: effects that are not identifiable against it from many recordings. One of two may name the other.
        separated_by: what to record to make them identifiable, the end of a sentence that begins with "record".
        standing_caveat: what to check before it is accepted for a standing robot, a sentence. Empty: nothing.
    """

    nominal: bool = False
    rank: int = LAST
    needs_ground: bool = False
    needs_stand: bool = False
    common: bool = False
    weighs_on_legs: bool = False
    of_gains: bool = False
    uniform: bool = False
    levels: tuple[Mapping[str, float], ...] = ()
    limits_torque: str = ""
    shapes: tuple[Mapping[str, float], ...] = ()
    free_shapes: tuple[str, ...] = ()
    laws: tuple[Mapping[str, float], ...] = ()
    periodic: Periodic | None = None
    simpler: str = ""
    simpler_if_equal: tuple[str, ...] = ()
    excitation: str = "chirp"
    confounded: tuple[str, ...] = ()
    separated_by: str = ""
    standing_caveat: str = ""


@dataclass(frozen=True)
class Param:
    """One parameter of an effect.

    Attributes:
        name: also the attribute that holds its values.
        unit: ``-`` for none.
        low: smallest value that makes sense.
        high: largest.
        null: value at which the effect is absent; a shape parameter, which matters only when another is not null,
            has its usual value here.
        tolerance: deviation from ``null`` that a user would not care about; the gap workflow names no effect within it.
            Infinite for a shape parameter.
        per: ``joint`` or ``robot``.
        doc: what it is, in a few words.
        least: smallest value but ``null``, where that one is a word for what the model has anyway and no value by
            itself (``Effect.nominal``), of a parameter of the robot; ``low`` if None.
    """

    name: str
    unit: str
    low: float
    high: float
    null: float
    tolerance: float
    per: Literal["joint", "robot"]
    doc: str
    least: float | None = None

    @property
    def smallest(self) -> float:
        """Smallest value at which the effect is there."""
        return self.low if self.least is None else self.least

    @property
    def annotation(self) -> object:
        """Type of the YAML value."""
        if self.least is not None:
            return Annotated[float, Field(ge=self.low, le=self.high), AfterValidator(self._apart)]
        if self.per == "joint":
            return Annotated[JointValues, each_within(self.low, self.high)]
        return Annotated[float, Field(ge=self.low, le=self.high)]

    def _apart(self, value: float) -> float:
        if value != self.null and value < self.smallest:
            raise ValueError(f"must be at least {self.smallest:g}, or {self.null:g} for that of the model")
        return value


@dataclass
class Measured:
    """What the robot's own sensors say, true values on the way in; what is not measured is None.

    Attributes:
        joint_pos: (N, J) rad.
        joint_vel: (N, J) rad/s.
        gravity: (N, 3) direction of gravity in the IMU's frame, unit length.
        gyro: (N, 3) rad/s in the IMU's frame.
        acc: (N, 3) specific force in the IMU's frame, m/s2.
        quat: (N, 4) orientation of the IMU in the world, w-x-y-z.
    """

    joint_pos: Tensor
    joint_vel: Tensor
    gravity: Tensor | None = None
    gyro: Tensor | None = None
    acc: Tensor | None = None
    quat: Tensor | None = None


@dataclass
class Gears:
    """How the gears between motors and joints yield (``sim/effects/gears.py``); zeros for gears that do not.

    Attributes:
        compliance: (N, J) twist per torque, rad/(N m).
        gap: (N, J) play, rad.
        damping: (N, J) damping ratio of the rotor on the gears' spring, the joint held.
    """

    compliance: Tensor
    gap: Tensor
    damping: Tensor


class Effect(Memory):
    """Base of all effects.

    A subclass has a ``title``, lists its ``params``, each of which is an attribute, and overrides the hooks that it
    needs and no others. All tensors are (N, J) unless said, angles in rad, speeds in rad/s, torques in N m.

    On the way of a torque, the hooks are called in this order, and among the effects of one hook in that of ``order``:
    ``on_target`` and ``on_feedforward``, ``on_encoder``, ``on_error``, the actuator, ``on_actuator``,
    ``on_transmission``, ``on_gears``, then ``on_joint``, ``on_friction``, ``on_load`` and ``on_base`` beside it.
    Whoever reads the actuators' torques asks ``on_report``.
    """

    title: ClassVar[str] = ""
    """What it is, as the object of a sentence: "the model does not have ..."."""
    params: ClassVar[tuple[Param, ...]] = ()
    identification: ClassVar[Identification] = Identification()
    """How it is looked for in recordings."""
    fields: ClassVar[tuple[str, ...]] = ()
    """Model fields that ``edit_model`` writes."""
    joint_values: ClassVar[tuple[str, ...]] = ()
    """Parameters with a value per joint (filled in by itself)."""
    mounts: ClassVar[bool] = False
    """Whether it acts on joints between the world and a trunk that is held (``sim/physics/scene.py``)."""
    order: ClassVar[int] = 0
    """Place among the effects of the same hook: smaller is nearer to the command."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Tensor:
            """Values of the parameter ``name``, (N, J) or (N, 1)."""

    def __init_subclass__(cls, **kwargs: object) -> None:
        super().__init_subclass__(**kwargs)
        cls.joint_values = tuple(p.name for p in cls.params if p.per == "joint")
        cls.memory = (*(p.name for p in cls.params), *cls.memory)
        keyword, positional = inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
        cls.__signature__ = inspect.Signature(  # type: ignore[attr-defined]  # the registry's schema
            [
                inspect.Parameter("setup", positional),
                *(inspect.Parameter(p.name, keyword, default=p.null, annotation=p.annotation) for p in cls.params),
            ]
        )

    def __init__(self, setup: ActuatorSetup, **values: JointValues) -> None:
        """Spread the values over joints and environments; joints that a mapping leaves out have the null value."""
        self.setup = setup
        for p in self.params:
            given = values.get(p.name, p.null)
            full = setup.rows(given) if p.per == "joint" else setup.zeros()[:, :1] + float(given)  # type: ignore[arg-type]
            setattr(self, p.name, full.nan_to_num(nan=p.null))

    @classmethod
    def nominal(cls, contact: ContactConfig) -> Mapping[str, float]:
        """Return, by parameter, what a robot with this contact has where the null value leaves that of the model."""
        return {}

    def prepare(self) -> None:
        """Work out what follows from the values; called when they have changed (``Plant.refresh``)."""

    # ------------------------------------------------------------------ where an effect may act

    def on_target(self, target: Tensor) -> Tensor:
        """Return the position target that the actuator acts on."""
        return target

    def on_feedforward(self, torque: Tensor) -> Tensor:
        """Return the feed-forward torque that reaches the actuator; only called where there is any (``Plant.step``)."""
        return torque

    def on_encoder(self, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        """Return angle and velocity that the encoder reads. Called more than once a step: changes nothing."""
        return q, qd

    def on_error(self, target: Tensor, q: Tensor) -> Tensor:
        """Return the target as the actuator compares it with ``q``, the angle that its encoder reads."""
        return target

    def on_gains(self, kp: Tensor, kd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gains that the actuator really has."""
        return kp, kd

    def on_actuator(self, torque: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque that the motor really makes. q, qd: the encoder's."""
        return torque

    def on_report(self, torque: Tensor) -> Tensor:
        """Return what the actuator reports of its ``torque``. Called more than once a step: changes nothing."""
        return torque

    def on_transmission(self, torque: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque that reaches the joint, whose true angle and speed are q and qd."""
        return torque

    def on_gears(self, gears: Gears) -> Gears:
        """Return how the gears yield, given how they do so far; what goes through them reaches the joint."""
        return gears

    def on_joint(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return a further torque that acts on the joint and is not the actuator's."""
        raise NotImplementedError

    def on_friction(self, bound: Tensor, torque: Tensor, qd: Tensor) -> Tensor:
        """Return the bound of the joint's dry friction under the actuator's ``torque``; ``bound`` is that so far."""
        return bound

    def on_load(self, bound: Tensor, torque: Tensor, outside: Tensor) -> Tensor:
        """Return the bound of the joint's dry friction with that of its loaded gears; ``bound`` is that so far.

        ``torque`` is the actuator's, ``outside`` what weight, Coriolis and centrifugal forces of the links make at the
        joint. A weight that is held at rest has ``outside = -torque``.
        """
        return bound

    def on_base(self, wrench: Tensor) -> Tensor:
        """Return the external wrench (N, 6) on the trunk; ``wrench`` is that so far.

        A force on the trunk's origin in the world's frame, N, then a torque in the trunk's frame, N m.
        """
        return wrench

    def on_sensor(self, measured: Measured) -> Measured:
        """Change what the robot's sensors say, as policy and logger see it (encoders are ``on_encoder``'s)."""
        return measured

    def edit_model(self, model: ModelFields) -> None:
        """Change ``fields`` of the model in place, every row; they hold the values without this effect."""

    def reset(self, mask: Tensor) -> None:
        """Begin a new episode in the rows of ``mask`` (N,)."""

    def elapse(self, seconds: Tensor) -> None:
        """Take up an episode that began ``seconds`` (N,) ago; called after ``reset``, where a replay begins later."""
