"""The Markov decision process: everything that turns a Snapshot into rewards, observations and resets.

Importing the package registers every term, from this explicit list.
"""

from go1exp.mdp import commands, curricula, events, observations, randomizations, rewards, rewards_literal  # noqa: F401
