"""What a case hides: draws of effects, backgrounds and experiments, all from one seed."""

from __future__ import annotations

import copy
import hashlib
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.gap import known, logger, outside
from benchmarks.gap.motions import MOTIONS, RATE
from benchmarks.gap.simulate import Episode
from benchmarks.gap.truth import Truth, apply, differences
from go1exp import robot

KINDS = ("null", "near_null", "single", "pair", "outside", "not_excited", "damaged")
SIZES = (1.0, 2.0, 5.0)
"""Sizes of single effects, in tolerances."""

GAINS = ((20.0, 0.5), (35.0, 0.6), (35.0, 1.2))
PITCHES = (0.0, 0.3)
"""Two ways to hang the robot, rad, that tell a tilted trunk from encoders that are off."""

OUTSIDE_SHARE = 0.2
"""Share of cases with one background error at 1.5 times its tolerance."""

SPREAD = 1.15
"""Largest of the values of an effect over the size that it is drawn for."""

EVERYTHING = ("chirp", "steps", "ramps", "gait", "swings", "chirp", "steps")
NOT_EXCITED: dict[str, tuple[str, ...]] = {
    "torque_speed_limit": ("gentle", "ramps", "gentle", "gentle", "ramps"),
    "armature": ("ramps",),
    "quadratic_drag": ("ramps", "gentle"),
    "lag": ("ramps",),
    "torque_delay": ("ramps",),
    "payload": EVERYTHING,
}
"""Effect -> motions that do not show it (the trunk of a suspended robot may weigh what it likes)."""

DAMAGES = (
    *("swapped_joints", "flipped_sign", "dropped", "shifted_commands", "degrees", "truncated", "frozen", "repeated"),
)

SUSPENDED = tuple(e for e in known.LIBRARY if e not in (*known.GROUND_ONLY, *known.NEVER_HIDDEN))
"""Effects that a suspended robot feels."""

Values = dict[str, np.ndarray | float]


@dataclass
class Case:
    """One case before it is simulated.

    Attributes:
        name: the case's folder; says nothing.
        kind: one of ``KINDS``.
        truth: the robot.
        without: the same robot before the case's effect.
        episodes: what is asked of it.
        dt: step, s.
        logger: its logger.
        on: (J,) joints of effects beyond the library.
        damage: what is done to the finished logs, or None.
        seed: of noise and gusts.
        answer: what the scorer will know.
    """

    name: str
    kind: str
    truth: Truth
    without: Truth
    episodes: list[Episode]
    dt: float
    logger: logger.Logger
    on: np.ndarray
    damage: str | None
    seed: tuple[int, ...]
    answer: dict[str, Any] = field(default_factory=dict)


def joints_of(scope: str, rng: np.random.Generator) -> np.ndarray:
    """Draw the joints of an effect: ``all``, those of one ``kind``, or a ``single`` one."""
    if scope == "all":
        return np.arange(robot.NUM_JOINTS)
    return np.arange(rng.integers(3), robot.NUM_JOINTS, 3) if scope == "kind" else np.array([rng.integers(12)])


# ---------------------------------------------------------------------- effects of the library


def draw_values(effect: str, size: float, joints: np.ndarray, rng: np.random.Generator) -> Values:
    """Draw parameters whose sizes are 1 to 1.15 times ``size`` tolerances, up or down where both make sense."""
    tolerance, n = known.TOLERANCES[effect], len(joints)

    def much(name: str) -> np.ndarray:
        return tolerance[name] * size * rng.uniform(1.0, SPREAD, n)

    sign = float(rng.choice((-1.0, 1.0)))
    if effect == "base_tilt":
        angle, course = tolerance["roll"] * size * rng.uniform(1.0, SPREAD), rng.uniform(0, 2 * np.pi)
        return {"roll": float(angle * np.cos(course)), "pitch": float(angle * np.sin(course))}
    if effect == "payload":
        return {"mass": float(much("mass")[0])}
    if effect == "joint_stop":
        way = str(rng.choice(("time_constant", "upper")))  # motions reach the upper stops of the calves at most
        return {way: (-1.0 if way == "upper" else 1.0) * much(way) + known.null(effect, way)}
    if effect == "link_com":
        # A hip turns about x, so that a shift along it shows nowhere in a robot that hangs.
        way = str(rng.choice(("along", "left") if np.any(joints % 3 == 0) else ("along", "forward", "left")))
        return {way: sign * much(way)}
    if effect in ("strength", "kp_scale", "kd_scale", "link_mass", "link_inertia"):
        change = much("scale")
        return {"scale": 1.0 + (1.0 if change.max() > 0.5 else sign) * change}  # a half is the least that makes sense
    if effect == "asymmetric_friction":
        ways = (much("forward"), np.zeros(n))
        return dict(zip(("forward", "backward"), ways if sign > 0 else ways[::-1], strict=True))
    if effect == "encoder_offset":
        return {"offset": much("offset") * rng.choice((-1.0, 1.0), n)}
    if effect == "torque_speed_limit":
        return {"peak": 1.0 - much("peak"), "droop": much("droop")}
    (main,) = tolerance
    shape: Values = {}
    if effect == "stribeck":
        shape = {"speed": np.full(n, rng.uniform(0.1, 0.5))}
    elif effect == "cogging":
        shape = {"count": np.full(n, float(rng.integers(20, 60))), "phase": rng.uniform(-np.pi, np.pi, n)}
    elif effect == "point_load":
        shape = {"x": np.zeros(n), "y": np.zeros(n), "z": rng.uniform(-0.213, -0.1, n)}  # down to where a shank ends
    elif effect == "parallel_stiffness":
        shape = {"rest": robot.NOMINAL_STANCE[joints] + rng.uniform(-0.2, 0.2, n)}
    return {main: much(main), **shape}


def effect_answer(effect: str, size: float, joints: np.ndarray, values: Values) -> dict[str, Any]:
    """Write an effect down as the scorer reads it; ``sizes`` are the parameters that have a tolerance.

    ``drawn`` is what was added, ``params`` what an estimate is compared with.
    """
    per_robot = effect in ("base_tilt", "payload")
    drawn = {k: v if isinstance(v, float) else [float(x) for x in v] for k, v in values.items()}
    return {
        "effect": effect,
        "size": size,
        "joints": [] if per_robot else [robot.JOINTS[j] for j in joints],
        "drawn": drawn,
        "params": dict(drawn),
        "sizes": [name for name in known.TOLERANCES[effect] if name in values],
    }


# ---------------------------------------------------------------------- the background


def background(truth: Truth, rng: np.random.Generator, beyond: str | None, most: float = 1.5) -> None:
    """Spoil a robot a little everywhere, within the tolerances; ``beyond`` names one error, up to ``most`` times it.

    Inside: masses 2 %, COM 1 mm, friction 0 to 0.03 N m and 0 to 0.01 N m s/rad, armature 10 %, strength 1.5 %,
    encoders 1 mrad, tilt 0.15 deg.
    """
    everything = np.arange(robot.NUM_JOINTS)

    def both(width: float, *shape: int) -> np.ndarray:
        return rng.uniform(-width, width, shape)

    truth.mass *= 1.0 + both(0.02, 12)
    truth.com += both(0.001, 12, 3) / np.sqrt(3.0)
    friction = rng.uniform(0, 0.03, 12)
    truth.forward += friction
    truth.backward += friction
    truth.viscous += rng.uniform(0, 0.01, 12)
    truth.armature = truth.armature * (1.0 + np.clip(both(0.1, 12), -1, 1))
    truth.strength *= 1.0 + both(0.015, 12)
    truth.offset += both(0.001, 12)
    truth.tilt += both(np.radians(0.15), 2) / np.sqrt(2.0)
    truth.bristle = float(np.exp(rng.uniform(np.log(600.0), np.log(3000.0))))
    if beyond is not None:
        values = draw_values(beyond, most / SPREAD, everything, rng)
        apply(truth, beyond, values, everything)


BEYOND = ("armature", "base_tilt", "coulomb", "encoder_offset", "link_com", "link_mass", "viscous")
"""Background errors that may be beyond tolerance."""


# ---------------------------------------------------------------------- the experiment


def experiment(motions: Sequence[str], count: int, seconds: float, rng: np.random.Generator) -> list[Episode]:
    """Return ``count`` episodes, the last an exact repetition of another; gains and attitudes go round."""
    t = np.arange(round(seconds * RATE)) / RATE
    first, episodes = int(rng.integers(3)), []
    for k in range(count - 1):
        name = motions[k % len(motions)]
        target, on = MOTIONS[name](t, rng)
        kp, kd = GAINS[(first + k) % 3]
        episodes.append(Episode(f"e{k:02d}", name, target, on, kp, kd, (0.0, PITCHES[k % 2])))
    old = episodes[int(rng.integers(len(episodes)))]
    again = Episode(
        f"e{count - 1:02d}", old.excitation, old.target, old.on, old.kp, old.kd, old.hang, repeat_of=old.name
    )
    return [*episodes, again]


# ---------------------------------------------------------------------- cases


def _cycle(choices: Sequence[Any], index: int) -> Any:
    return choices[index % len(choices)]


def make(
    kind: str,
    index: int,
    seed: int,
    count: int = 8,
    seconds: float = 5.0,
    only: Sequence[str] = (),
    sizes: Sequence[float] = SIZES,
) -> Case:
    """Draw case ``index`` of a kind; the same arguments give the same case, whatever others there are.

    Args:
        kind: one of ``KINDS``.
        index: effects, sizes and joints go round with it, so that many cases are balanced.
        seed: of the whole benchmark.
        count: episodes of the case.
        seconds: length of an episode.
        only: take the single effects from these.
        sizes: of single effects, in tolerances.
    """
    root = np.random.SeedSequence([seed, zlib.crc32(kind.encode()), index])
    world, noise = root.spawn(2)
    rng = np.random.default_rng(world)
    name = "case_" + hashlib.sha256(f"{seed} {kind} {index}".encode()).hexdigest()[:12]
    truth, damage, on = Truth(), None, np.zeros(12, dtype=bool)
    motions: tuple[str, ...] = EVERYTHING
    names = tuple(only) or SUSPENDED
    effects: list[dict[str, Any]] = []
    clean = kind == "null" and index % 4 == 0
    beyond = str(rng.choice(BEYOND)) if not clean and kind != "damaged" and rng.random() < OUTSIDE_SHARE else None
    if kind == "near_null":
        beyond = _cycle(BEYOND, index)
    if not clean:
        background(truth, rng, beyond, rng.uniform(SPREAD, 1.5) if kind == "near_null" else 1.5)

    without = copy.deepcopy(truth)

    def add(effect: str, size: float, scope: str) -> None:
        joints = joints_of(scope, rng)
        values = draw_values(effect, size, joints, rng)
        apply(truth, effect, values, joints)
        effects.append(effect_answer(effect, size, joints, values))

    detail: dict[str, Any] = {}
    if kind == "single":
        scope = str(rng.choice(("all", "kind", "single"), p=(0.4, 0.4, 0.2)))
        add(_cycle(names, index), _cycle(tuple(sizes), index // len(names)), scope)
    elif kind == "pair":
        add(*_pair(rng, names))
        add(*_pair(rng, [e for e in names if e not in known.family(effects[0]["effect"]) | _CLASH]))
    elif kind == "outside":
        which = _cycle(tuple(outside.EFFECTS), index)
        on[joints_of(str(rng.choice(("all", "kind"))), rng)] = True
        if which == "coupled_joints":
            on[:] = np.arange(12) % 3 == 1
        truth.outside[which] = {k: float(rng.uniform(*r)) for k, r in outside.SIZES[which].items()}
        detail["outside"] = {"effect": which, "params": truth.outside[which], "joints": _names(on)}
    elif kind == "not_excited":
        which = _cycle(tuple(NOT_EXCITED), index)
        motions = NOT_EXCITED[which]
        add(which, 2.0 if which in ("armature", "lag", "torque_delay") else 4.0, "all")
    elif kind == "damaged":
        damage = _cycle(DAMAGES, index)
        detail["damage"] = damage
    elif kind not in ("null", "near_null"):
        raise ValueError(f"no kind {kind!r}; there are {', '.join(KINDS)}")
    for effect in effects:
        at = np.array([robot.JOINTS.index(name) for name in effect["joints"]], dtype=int)
        for key, value in differences(truth, effect["effect"], at).items():
            effect["params"][key] = value if isinstance(value, float) else [float(x) for x in value]
    case_seed = tuple(int(x) for x in noise.generate_state(4))
    episodes = experiment(motions, count, seconds, rng)
    dt = 1e-4 if truth.yielding.any() else float(rng.choice([2e-4, 2.5e-4]))
    answer = {"kind": kind, "effects": effects, "background_beyond": beyond, "clean": clean, "dt": dt, **detail}
    return Case(name, kind, truth, without, episodes, dt, logger.draw(rng), on, damage, case_seed, answer)


_CLASH = {"backlash", "flexibility", "asymmetric_friction"}
"""Effects that are second of no pair: what they do depends on the first, or they are a pair themselves."""


def _pair(rng: np.random.Generator, names: Sequence[str]) -> tuple[str, float, str]:
    return str(rng.choice(list(names))), float(rng.choice((3.0, 5.0))), str(rng.choice(("all", "kind")))


def _names(on: np.ndarray) -> list[str]:
    return [name for name, acts in zip(robot.JOINTS, on, strict=True) if acts]


def plan(kinds: Sequence[str], n: int, make_case: Callable[[str, int], Case]) -> list[Case]:
    """Return ``n`` cases of each kind, in an order that says nothing about them."""
    return sorted((make_case(kind, index) for kind in kinds for index in range(n)), key=lambda case: case.name)
