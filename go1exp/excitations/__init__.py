"""Motions that a robot is driven through so that what its model lacks becomes visible.

Importing the package registers every excitation, from this explicit list.
"""

from go1exp.excitations import ground, hung, switched
from go1exp.excitations.motion import ExcitationError, Motion

__all__ = ["ExcitationError", "Motion", "ground", "hung", "switched"]
