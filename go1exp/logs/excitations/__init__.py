"""Motions for identification: they make errors of the robot's model visible in the recordings.

Importing the package registers every excitation, from this explicit list.
"""

from go1exp.logs.excitations import ground, suspended, switched
from go1exp.logs.excitations.motion import ExcitationError, Motion

__all__ = ["ExcitationError", "Motion", "ground", "suspended", "switched"]
