"""Contacts of MuJoCo Warp with a height field, by the law of MuJoCo itself.

Both engines look for the nearest points of a shape and each prism under a triangle of the field. Where they lie on a
side of the prism, mujoco-warp 4.0.0 takes the vertical distance to one of its upper corners instead, and where a shape
leaves a prism most easily through a side, the vertical distance to the triangle's plane, wherever that is met. The foot
of a robot beside the edge of a box is then centimetres or metres deep in the ground, and the robot is thrown out. Here
the nearest points stay what they are, as in MuJoCo, which ``tests/test_warp_height_field.py`` compares.
"""

from __future__ import annotations

import inspect

import warp as wp
from mujoco_warp._src import collision_gjk
from mujoco_warp._src.collision_gjk import Geom, GJKResult, Polytope, _get_face_verts, _tri_affine_coord

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
