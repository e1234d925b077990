"""What an identification must know of an effect beside its law: where to look for it, and with what it is confused.

Every effect carries one :class:`Identification` (``Effect.identification``); the gap workflow reads it and knows no
effect by name. The defaults suit an effect of the joints that most models leave out and that any motion shows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

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
