"""Numbers of ``base.tensors.randomness`` in one kernel, bit for bit, where each of its operations would be one."""

from __future__ import annotations

import warp as wp

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
