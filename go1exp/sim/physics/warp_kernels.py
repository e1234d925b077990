"""Kernels beside MuJoCo Warp's own: contact sensors in one pass, MuJoCo's law of height fields, random numbers.

Its own contact sensors look for every sensor at every contact, and sort; here, where all contacts are with the ground,
each contact knows its sensors. That is a fifth of a physics step. The readings are the same but for the order of sums.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from unittest import mock

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp._src import collision_gjk
from mujoco_warp._src.collision_gjk import Geom, GJKResult, Polytope, _get_face_verts, _tri_affine_coord

from go1exp import robot
from go1exp.sim.physics.scene import CONTACT_LINKS, FLOOR, Sensors

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


@contextmanager
def side_by_side(device: wp.Device) -> Iterator[None]:
    """Compile all kernels that the block launches, each module in a thread of its own; nothing is launched.

    Warp compiles a module when a kernel of it is launched, one after the other, and MuJoCo Warp makes thirty modules
    for a model.
    """
    sizes: dict[wp.Module, set[int | None]] = {}

    def note(
        kernel: wp.Kernel, dim: int | Sequence[int], *_: object, block_dim: int | None = None, **__: object
    ) -> None:
        if np.prod(dim) > 0:  # of what a model does not have, there is nothing to launch
            sizes.setdefault(kernel.module, set()).add(block_dim)

    def once(_: object, while_body: Callable[..., None], **given: object) -> None:
        while_body(**given)

    def load(module: wp.Module) -> None:
        for size in sizes[module]:
            wp.force_load(device, [module], block_dim=size, max_workers=0)

    with mock.patch.multiple(wp, launch=note, launch_tiled=note, capture_while=once):
        yield
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(load, sorted(sizes, key=lambda module: -len(module.kernels))))  # the longest first


class ContactReadings:
    """Fills the contact blocks of ``sensordata`` (``sim/physics/scene.py``)."""

    def __init__(self, model: mujoco.MjModel, sensors: Sensors, capacity: int) -> None:
        """Find out where each shape's readings lie; ``capacity`` is the length of the list of contacts."""
        column = {model.body(name).id: sensors.link_contacts.start + k for k, name in enumerate(CONTACT_LINKS)}
        foot = {model.geom(name).id: sensors.foot_contact.start + 4 * k for k, name in enumerate(robot.FEET)}
        self._foot_at = wp.array([foot.get(g, -1) for g in range(model.ngeom)], dtype=int)
        self._link_at = wp.array([column.get(int(body), -1) for body in model.geom_bodyid], dtype=int)
        self._floor = int(model.geom(FLOOR).id)
        self._ids = wp.array(np.arange(capacity), dtype=int)
        self._force = wp.zeros(capacity, dtype=wp.spatial_vector)

    def update(self, model: mjw.Model, data: mjw.Data) -> None:
        """Add the contacts of the last pass to readings that are zero."""
        mjw.contact_force(model, data, self._ids, True, self._force)
        c = data.contact
        inputs = [data.nacon, c.type, c.worldid, c.geom, self._force, self._floor, self._foot_at, self._link_at]
        wp.launch(_collect, len(self._ids), inputs=inputs, outputs=[data.sensordata])


def without_contact_sensors(model: mjw.Model) -> None:
    """Let a ``mujoco_warp.Model`` leave its contact sensors at zero."""
    for stage in ("pos", "vel", "acc"):
        setattr(model, f"sensor_contact_{stage}_adr", wp.zeros(0, dtype=int))


_GAMMA = wp.constant(wp.uint64(0x9E3779B97F4A7C15))
_MIX_1 = wp.constant(wp.uint64(0xBF58476D1CE4E5B9))
_MIX_2 = wp.constant(wp.uint64(0x94D049BB133111EB))


@wp.kernel(enable_backward=False)
def units_kernel(key: wp.array2d[wp.int64], counter: wp.array[wp.int64], out: wp.array2d[float]) -> None:
    """Write number ``counter + 1 + k`` of each environment's sequence, uniform in [0, 1), one a thread."""
    env, k = wp.tid()
    index = wp.uint64(counter[0]) + wp.uint64(k) + wp.uint64(1)
    z = wp.uint64(key[env, 0]) + index * _GAMMA
    z = (z ^ (z >> wp.uint64(30))) * _MIX_1
    z = (z ^ (z >> wp.uint64(27))) * _MIX_2
    z = z ^ (z >> wp.uint64(31))
    out[env, k] = float(z >> wp.uint64(40)) * wp.float32(5.9604644775390625e-08)  # 2^-24


_SPECIAL = "HFIELD"
"""What the source of a function names that treats height fields by themselves."""


@wp.func
def _inflate(
    result: GJKResult, geom1: Geom, geom2: Geom, geomtype1: int, geomtype2: int, margin1: float, margin2: float
) -> tuple[float, wp.vec3, wp.vec3]:
    """Return distance and nearest points of two rounded shapes, from those of the shapes without their roundings, m."""
    toward = wp.normalize(result.x2 - result.x1)
    return result.dist - margin1 - margin2, result.x1 + margin1 * toward, result.x2 - margin2 * toward


@wp.func
def _epa_witness(
    pt: Polytope, geom1: Geom, geom2: Geom, geomtype1: int, geomtype2: int, face_idx: int
) -> tuple[wp.vec3, wp.vec3, float]:
    """Return the points of two shapes that are deepest in each other, and their distance (< 0), m.

    ``face_idx`` is the face of the polytope, in differences of points, that is nearest to the origin.
    """
    corners = _get_face_verts(pt.face[face_idx])
    first, second, third = 2 * corners[0], 2 * corners[1], 2 * corners[2]
    share = _tri_affine_coord(
        pt.vert[first] - pt.vert[first + 1],
        pt.vert[second] - pt.vert[second + 1],
        pt.vert[third] - pt.vert[third + 1],
        pt.face_pr[face_idx],
    )
    x1 = share[0] * pt.vert[first] + share[1] * pt.vert[second] + share[2] * pt.vert[third]
    x2 = share[0] * pt.vert[first + 1] + share[1] * pt.vert[second + 1] + share[2] * pt.vert[third + 1]
    return x1, x2, -wp.sqrt(pt.face_norm2[face_idx])


def use_mujocos_law() -> tuple[str, ...]:
    """Replace what treats height fields otherwise than MuJoCo, before a kernel is built; return the names replaced.

    A function that treats no height field by itself is left as it is. Names of the engine's own are private: the extra
    ``gpu`` allows the releases that have them.
    """
    replaced = []
    for function in (_inflate, _epa_witness):
        theirs = getattr(collision_gjk, function.func.__name__, None)
        if theirs is not None and theirs is not function and _SPECIAL in inspect.getsource(theirs.func):
            setattr(collision_gjk, function.func.__name__, function)
            replaced.append(function.func.__name__)
    return tuple(replaced)
