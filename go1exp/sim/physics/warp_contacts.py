"""The contact sensors of the scene, read off MuJoCo Warp's list of contacts in one pass.

Its own contact sensors look for every sensor at every contact, and sort; here, where all contacts are with the ground,
each contact knows its sensors. That is a fifth of a physics step. The readings are the same but for the order of sums.
"""

from __future__ import annotations

from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from go1exp import robot
from go1exp.sim.physics.scene import Sensors
from go1exp.sim.physics.terrain_geom import FLOOR

_CONSTRAINT = 1
"""Bit of a contact that takes part in the dynamics (``mujoco_warp``'s ``ContactType.CONSTRAINT``)."""


@wp.kernel(enable_backward=False)
def _collect(
    count: wp.array[int],
    kind: wp.array[int],
    world: wp.array[int],
    geoms: wp.array[wp.vec2i],
    force: wp.array[wp.spatial_vector],
    floor: int,
    foot_at: wp.array[int],
    link_at: wp.array[int],
    out: wp.array2d[float],
) -> None:
    """Add one contact to the sensors of its shape, one a thread."""
    contact = wp.tid()
    if contact >= wp.min(count[0], geoms.shape[0]):
        return
    if (kind[contact] & _CONSTRAINT) == 0:
        return
    pair = geoms[contact]
    other = pair[1]
    sign = wp.float32(1.0)  # the force is the first's on the second
    if pair[1] == floor:
        other = pair[0]
        sign = -1.0
    row = world[contact]
    if link_at[other] >= 0:
        wp.atomic_add(out, row, link_at[other], 1.0)
    foot = foot_at[other]
    if foot >= 0:
        wp.atomic_add(out, row, foot, 1.0)
        for axis in range(3):
            wp.atomic_add(out, row, foot + 1 + axis, sign * force[contact][axis])


class ContactReadings:
    """Fills the contact blocks of ``sensordata`` (``sim/physics/scene.py``)."""

    def __init__(self, model: mujoco.MjModel, sensors: Sensors, capacity: int) -> None:
        """Find out where each shape's readings lie; ``capacity`` is the length of the list of contacts."""
        links = [f"{leg}_{part}" for part in ("thigh", "calf") for leg in robot.LEGS]
        links += ["trunk", *(f"{leg}_hip" for leg in robot.LEGS)]
        column = {model.body(name).id: sensors.link_contacts.start + k for k, name in enumerate(links)}
        foot = {model.geom(f"{leg}_foot").id: sensors.foot_contact.start + 4 * k for k, leg in enumerate(robot.LEGS)}
        self._foot_at = wp.array([foot.get(g, -1) for g in range(model.ngeom)], dtype=int)
        self._link_at = wp.array([column.get(int(body), -1) for body in model.geom_bodyid], dtype=int)
        self._floor = int(model.geom(FLOOR).id)
        self._ids = wp.array(np.arange(capacity), dtype=int)
        self._force = wp.zeros(capacity, dtype=wp.spatial_vector)

    def update(self, model: Any, data: Any) -> None:
        """Add the contacts of the last pass to readings that are zero."""
        mjw.contact_force(model, data, self._ids, True, self._force)
        c = data.contact
        inputs = [data.nacon, c.type, c.worldid, c.geom, self._force, self._floor, self._foot_at, self._link_at]
        wp.launch(_collect, len(self._ids), inputs=inputs, outputs=[data.sensordata])


def without_contact_sensors(model: Any) -> None:
    """Let a ``mujoco_warp.Model`` leave its contact sensors at zero."""
    for stage in ("pos", "vel", "acc"):
        setattr(model, f"sensor_contact_{stage}_adr", wp.zeros(0, dtype=int))
