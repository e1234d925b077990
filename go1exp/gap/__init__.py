"""Find where simulation and measurement disagree, and name the effect that is missing.

``stages.explain.explain`` is the way in, ``result.GapResult`` the answer; ``stages.apply`` writes it for training,
``report`` for people.
"""
