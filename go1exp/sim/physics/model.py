"""The robot as an editable MuJoCo specification."""

from __future__ import annotations

from typing import Any

import mujoco

from go1exp.base.paths import data_root

TRUNK_WITH_HIP_ROTORS: dict[str, Any] = {
    "mass": 5.560,
    "ipos": [0.020872158, 0.001871942, -0.000467986],
    "fullinertia": [0.0180397001, 0.0678915698, 0.0773160421, -2.44537877e-4, -2.90814056e-4, -4.15398942e-5],
}
"""Trunk plus the four hip rotors that turn inside it, trunk frame: mass, kg; COM, m; inertia about the COM as xx, yy,
zz, xy, xz, yz, kg m2.

Computed from the vendor URDF: trunk 5.204 kg and four rotors of 0.089 kg at (+-0.11215, +-0.04675, 0), 1.11842e-4 about
their x axis and 5.9647e-5 across it. Its IMU, camera and ultrasound links (1.08 g together) are left out.
"""

INERTIA_VARIANTS = ("merged", "rotor_complete")


def load_robot(inertia: str = "merged") -> mujoco.MjSpec:
    """Load ``assets/go1/go1.xml``: the robot alone, without floor, lights or sensors.

    Args:
        inertia: ``merged`` (12.743 kg) omits the hip rotors, as MuJoCo Menagerie and its descendants do;
            ``rotor_complete`` (13.099 kg) adds them to the trunk, as the vendor URDF does.
    """
    if inertia not in INERTIA_VARIANTS:
        raise ValueError(f"inertia {inertia!r} is none of {', '.join(INERTIA_VARIANTS)}")
    spec = mujoco.MjSpec.from_file(str(data_root() / "assets/go1/go1.xml"))
    if inertia == "rotor_complete":
        trunk = spec.body("trunk")
        for field, value in TRUNK_WITH_HIP_ROTORS.items():
            setattr(trunk, field, value)
    return spec
