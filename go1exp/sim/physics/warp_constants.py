"""What follows from masses and inertias, in the rows that ask for it, on the device: ``mj_setConst`` for one tree.

``mujoco_warp.set_const`` works out every row, in some hundred products of the whole batch, which would cost a quarter
of a policy step; at a reset few rows need it. Here rows that are not meant end at once. The law is MuJoCo's: at
``qpos0``, with J the Jacobian of a body's centre of mass, ``body_invweight0`` is the mean diagonal of J M^-1 J^T, by
translation and by rotation, ``dof_invweight0`` the diagonal of M^-1, averaged over the axes of a free joint.
``actuator_acc0`` (for muscles) and ``stat.meaninertia`` (a scale of the solver's tolerance) stay the compiled ones.
"""

from __future__ import annotations

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

MOST = 18
"""Degrees of freedom, at most: a free trunk and twelve joints."""

_Row = wp.types.vector(length=MOST, dtype=float)

DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0")
"""The fields that are worked out."""


@wp.func
def _velocity(
    dof: int, point: wp.vec3, lin: wp.array[wp.vec3], ang: wp.array[wp.vec3], at: wp.array[wp.vec3]
) -> wp.vec3:
    """Velocity of a point that moves with a degree of freedom at unit speed."""
    return lin[dof] + wp.cross(ang[dof], point - at[dof])


@wp.func
def _centre(
    row: int, body: int, xpos: wp.array[wp.vec3], xmat: wp.array[wp.mat33], ipos: wp.array2d[wp.vec3]
) -> wp.vec3:
    """Centre of mass of a body in the world."""
    return xpos[body] + xmat[body] * ipos[row % ipos.shape[0], body]


@wp.func
def _turned(quat: wp.quat, v: wp.vec3) -> wp.vec3:
    """Express ``v`` in the frame of ``quat``, which holds w-x-y-z in this order, as MuJoCo does."""
    w = quat[0]
    axis = wp.vec3(quat[1], quat[2], quat[3])
    t = 2.0 * wp.cross(axis, v)
    return v - w * t + wp.cross(axis, t)


@wp.kernel(enable_backward=False)
def _inertia(
    mask: wp.array[wp.bool],
    moves: wp.array2d[int],
    lin: wp.array[wp.vec3],
    ang: wp.array[wp.vec3],
    at: wp.array[wp.vec3],
    xpos: wp.array[wp.vec3],
    xmat: wp.array[wp.mat33],
    mass: wp.array2d[float],
    inertia: wp.array2d[wp.vec3],
    ipos: wp.array2d[wp.vec3],
    iquat: wp.array2d[wp.quat],
    armature: wp.array2d[float],
    out: wp.array3d[float],
) -> None:
    """Joint-space inertia, one entry a thread."""
    row, i, j = wp.tid()
    if not mask[row]:
        return
    total = wp.float32(0.0)
    for body in range(1, moves.shape[0]):
        if moves[body, i] != 0 and moves[body, j] != 0:
            point = _centre(row, body, xpos, xmat, ipos)
            total += mass[row % mass.shape[0], body] * wp.dot(
                _velocity(i, point, lin, ang, at), _velocity(j, point, lin, ang, at)
            )
            frame = iquat[row % iquat.shape[0], body]
            a = _turned(frame, wp.transpose(xmat[body]) * ang[i])
            b = _turned(frame, wp.transpose(xmat[body]) * ang[j])
            total += wp.dot(a, wp.cw_mul(inertia[row % inertia.shape[0], body], b))
    if i == j:
        total += armature[row % armature.shape[0], i]
    out[row, i, j] = total


@wp.kernel(enable_backward=False)
def _factor(mask: wp.array[wp.bool], inout: wp.array3d[float]) -> None:
    """Cholesky factor (lower) in place, one row a thread."""
    row = wp.tid()
    if not mask[row]:
        return
    for j in range(inout.shape[1]):
        for k in range(j):
            for i in range(j, inout.shape[1]):
                inout[row, i, j] = inout[row, i, j] - inout[row, i, k] * inout[row, j, k]
        root = wp.sqrt(inout[row, j, j])
        for i in range(j, inout.shape[1]):
            inout[row, i, j] = inout[row, i, j] / root


@wp.kernel(enable_backward=False)
def _responses(
    mask: wp.array[wp.bool],
    moves: wp.array2d[int],
    lin: wp.array[wp.vec3],
    ang: wp.array[wp.vec3],
    at: wp.array[wp.vec3],
    xpos: wp.array[wp.vec3],
    xmat: wp.array[wp.mat33],
    ipos: wp.array2d[wp.vec3],
    factor: wp.array3d[float],
    out: wp.array2d[float],
) -> None:
    """J M^-1 J^T = |L^-1 J^T|^2 of a degree of freedom, or of an axis of a body's centre, one a thread."""
    row, k = wp.tid()
    if not mask[row]:
        return
    nv = factor.shape[1]
    y = _Row()
    body = (k - nv) // 6
    axis = (k - nv) % 6
    point = _centre(row, wp.max(body, 0), xpos, xmat, ipos)
    total = wp.float32(0.0)
    for i in range(nv):
        value = wp.float32(0.0)
        if k < nv:
            if i == k:
                value = 1.0
        elif moves[body, i] != 0:
            if axis < 3:
                velocity = _velocity(i, point, lin, ang, at)
                value = velocity[axis]
            else:
                turn = ang[i]
                value = turn[axis - 3]
        for j in range(i):
            value -= factor[row, i, j] * y[j]
        value = value / factor[row, i, i]
        y[i] = value
        total += value * value
    out[row, k] = total


@wp.kernel(enable_backward=False)
def _weights(
    mask: wp.array[wp.bool],
    moves: wp.array2d[int],
    below: wp.array2d[int],
    mass: wp.array2d[float],
    response: wp.array2d[float],
    free: int,
    subtreemass: wp.array2d[float],
    body_invweight0: wp.array2d[wp.vec2],
    dof_invweight0: wp.array2d[float],
) -> None:
    """Average and write, one body or degree of freedom a thread."""
    row, k = wp.tid()
    if not mask[row]:
        return
    nv = moves.shape[1]
    if k < nv:
        value = response[row, k]
        if free != 0 and k < 6:
            first = (k // 3) * 3
            value = (response[row, first] + response[row, first + 1] + response[row, first + 2]) / 3.0
        dof_invweight0[row, k] = value
    if k < moves.shape[0]:
        total = wp.float32(0.0)
        for other in range(moves.shape[0]):
            if below[k, other] != 0:
                total += mass[row % mass.shape[0], other]
        subtreemass[row, k] = total
        first = nv + 6 * k
        by_force = (response[row, first] + response[row, first + 1] + response[row, first + 2]) / 3.0
        by_torque = (response[row, first + 3] + response[row, first + 4] + response[row, first + 5]) / 3.0
        body_invweight0[row, k] = wp.vec2(by_force, by_torque)


class DerivedConstants:
    """Works out ``DERIVED`` for rows of a batch."""

    def __init__(self, model: mujoco.MjModel, num_envs: int) -> None:
        """Take the tree's geometry at ``qpos0`` from the compiled model; arrays go to warp's present device.

        Raises:
            NotImplementedError: if the model has other joints than hinges and one free joint, or bodies that are fixed
                to the world and have mass.
        """
        kinds = set(model.jnt_type[1:].tolist()) | {int(mujoco.mjtJoint.mjJNT_HINGE)}
        first = int(model.jnt_type[0])
        if kinds != {int(mujoco.mjtJoint.mjJNT_HINGE)} or model.nv > MOST:
            raise NotImplementedError("derived constants are for one robot of hinges, its trunk free or held")
        self._free = first == int(mujoco.mjtJoint.mjJNT_FREE)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        nv, lin, ang, at = model.nv, np.zeros((model.nv, 3)), np.zeros((model.nv, 3)), np.zeros((model.nv, 3))
        for dof in range(nv):
            joint = int(model.dof_jntid[dof])
            at[dof], ang[dof] = data.xanchor[joint], data.xaxis[joint]
        if self._free:
            lin[:3], ang[:3] = np.eye(3), 0.0
            ang[3:6] = data.xmat[1].reshape(3, 3).T
        below = np.eye(model.nbody, dtype=np.int32)
        for body in range(model.nbody - 1, 0, -1):  # children come after their parents
            below[model.body_parentid[body]] |= below[body]
        moves = below[model.dof_bodyid].T  # a body is moved by the joints of all bodies that it hangs on
        self._moves, self._below = wp.array(moves, dtype=int), wp.array(below, dtype=int)
        self._lin, self._ang, self._at = (wp.array(a, dtype=wp.vec3) for a in (lin, ang, at))
        self._xpos = wp.array(data.xpos, dtype=wp.vec3)
        self._xmat = wp.array(data.xmat.reshape(-1, 3, 3), dtype=wp.mat33)
        self._factor = wp.zeros((num_envs, nv, nv), dtype=float)
        self._response = wp.zeros((num_envs, nv + 6 * model.nbody), dtype=float)
        self._shape = num_envs, nv, int(model.nbody)

    def update(self, model: mjw.Model, mask: wp.array) -> None:
        """Write ``DERIVED``, which must be per environment in the ``mujoco_warp.Model``, in the rows of ``mask``."""
        n, nv, nbody = self._shape
        tree = [self._moves, self._lin, self._ang, self._at, self._xpos, self._xmat]
        bodies = [model.body_mass, model.body_inertia, model.body_ipos, model.body_iquat, model.dof_armature]
        wp.launch(_inertia, (n, nv, nv), inputs=[mask, *tree, *bodies], outputs=[self._factor])
        wp.launch(_factor, n, inputs=[mask], outputs=[self._factor])
        inputs = [mask, *tree, model.body_ipos, self._factor]
        wp.launch(_responses, (n, nv + 6 * nbody), inputs=inputs, outputs=[self._response])
        wp.launch(
            _weights,
            (n, max(nv, nbody)),
            inputs=[mask, self._moves, self._below, model.body_mass, self._response, int(self._free)],
            outputs=[getattr(model, name) for name in DERIVED],
        )
