"""Everything that a file of your own terms imports: ``docs/extending.md`` has an example of each kind.

Importing this registers every term of the package first, so that a name of yours that exists already is refused.
"""

from __future__ import annotations

import go1exp.logs.importers
import go1exp.logs.record.motions  # noqa: F401  (registers an excitation)
from go1exp import robot
from go1exp.base.tensors.memory import Memory
from go1exp.base.tensors.randomness import Stream
from go1exp.config.schema.joint_values import JointValues, each_within
from go1exp.config.schema.registry import (
    Fraction,
    NonNegative,
    Positive,
    PositiveRange,
    Range,
    Speed,
    SpeedRange,
    actuator,
    command,
    curriculum,
    effect,
    event,
    excitation,
    importer,
    measure,
    observation,
    randomization,
    reward,
    termination,
)
from go1exp.logs.excitations import ExcitationError, Motion
from go1exp.logs.excitations.motion import always_on
from go1exp.logs.importers.source import rate, recording
from go1exp.logs.recording import Recording, RecordingError, columns, joint_columns
from go1exp.mdp import mirror
from go1exp.mdp.kinematics import KinematicState
from go1exp.mdp.measures.trace import NotMeasured, Trace
from go1exp.mdp.mirror import Mirror
from go1exp.mdp.types import Snapshot, TermSetup
from go1exp.robot.actuators import ActuatorSetup, ModelFields
from go1exp.sim.actuator.motors import Gains
from go1exp.sim.effects.base import Effect, Gears, Identification, Measured, Param

__all__ = ["actuator", "command", "curriculum", "effect", "event", "excitation", "importer", "measure", "observation"]
__all__ += ["randomization", "reward", "termination"]
__all__ += ["Fraction", "JointValues", "NonNegative", "Positive", "PositiveRange", "Range", "Speed", "SpeedRange"]
__all__ += ["ActuatorSetup", "Effect", "Gains", "Gears", "Identification", "Measured", "ModelFields", "Param"]
__all__ += ["KinematicState", "Memory", "Mirror", "NotMeasured", "Snapshot", "Stream", "TermSetup", "Trace"]
__all__ += ["ExcitationError", "Motion", "Recording", "RecordingError", "always_on", "each_within", "mirror", "robot"]
__all__ += ["columns", "joint_columns", "rate", "recording"]
