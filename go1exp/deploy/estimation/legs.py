"""Kinematics of the legs in NumPy, equal to ``cpp/legs.hpp``."""

from __future__ import annotations

import numpy as np

from go1exp.deploy.estimation.config import ChainLeg, PolynomialLeg

EXPONENTS = np.array([(i, j, k) for i in range(5) for j in range(5 - i) for k in range(5 - i - j)])
"""Exponents (35, 3) of a polynomial leg's terms."""


def foot(leg: ChainLeg | PolynomialLeg, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a foot in the trunk's frame for joint angles ``q`` (3,), rad.

    Returns:
        Its position (3,), m; the Jacobian (3, 3) of the position, m/rad; and ``turning`` (3, 3), which maps joint
        velocities to the angular velocity of the foot's link relative to the trunk (zero if that is not known).
    """
    if isinstance(leg, PolynomialLeg):
        u = (q - np.array(leg.centre)) / leg.scale
        coefficients = np.array([leg.x, leg.y, leg.z])
        terms = (u**EXPONENTS).prod(axis=1)
        slope = np.stack([_slope(u, d) for d in range(3)], axis=1) / leg.scale
        return coefficients @ terms, coefficients @ slope, np.zeros((3, 3))
    (hip, thigh, calf), (side, upper, lower) = q, leg.lengths
    # Rotation of the hip about x; thigh and calf move in the plane that it turns.
    about_x = np.array([[1, 0, 0], [0, np.cos(hip), -np.sin(hip)], [0, np.sin(hip), np.cos(hip)]])
    knee = np.array([-upper * np.sin(thigh), 0, -upper * np.cos(thigh)])
    shin = np.array([-lower * np.sin(thigh + calf), 0, -lower * np.cos(thigh + calf)])
    below = np.array([0, side, 0]) + knee + shin
    # Column j of the Jacobian: axis of joint j x arm from it to the foot.
    axes = np.array([[1.0, 0, 0], about_x[:, 1], about_x[:, 1]])
    arms = [about_x @ below, about_x @ (knee + shin), about_x @ shin]
    return np.array(leg.hip) + about_x @ below, np.cross(axes, arms).T, axes.T


def _slope(u: np.ndarray, axis: int) -> np.ndarray:
    """Return the derivative (35,) of the terms by one of their variables."""
    lower = EXPONENTS.copy()
    lower[:, axis] = np.maximum(lower[:, axis] - 1, 0)
    return EXPONENTS[:, axis] * (u**lower).prod(axis=1)
