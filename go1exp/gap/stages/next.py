"""The stage ``next``: from an answer to the recording that separates what it leaves open."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain
from typing import Any

import numpy as np

from go1exp.base.tensors.threads import one_thread
from go1exp.base.wording import counted
from go1exp.gap.comparison import Comparison, Progress, compare, robot_from
from go1exp.gap.data.prepare import fingerprint
from go1exp.gap.design.choice import COARSE, ENOUGH, Choice, Evaluator, Pair, Worth, choose
from go1exp.gap.design.plan import Attitude, DesignError, DesignSettings, limits_of
from go1exp.gap.design.rehearsal import Rehearsal, Stage
from go1exp.gap.replay.rows import Theta
from go1exp.gap.result import Candidate, GapResult, GapSettings, NamedEffect
from go1exp.gap.robots.protocol import Robot
from go1exp.gap.search import significance, thresholds, tolerances
from go1exp.gap.search.screen import Motion, library, motion
from go1exp.gap.stages.apply import composed, read_as, terms_of, theta_of
from go1exp.logs.record.simulate import held_quat
from go1exp.logs.recording import Recording
from go1exp.robot import JOINTS
from go1exp.robot.config import RobotConfig
from go1exp.sim.effects.tolerances import sizes

WIDEST = 0.5  # largest relative standard deviation of a size that is believed; an interval across null would have any


@dataclass(frozen=True)
class Verdict:
    """What becomes of a pair."""

    truth: str  # effect of the answer, or one that the recordings did not excite
    rival: str  # effect that could be there in its place; empty for none
    before: Worth  # what the recordings at hand say
    after: Worth  # what they say with the designed one
    reason: str  # why it is not separable; empty if it is

    @property
    def text(self) -> str:
        """In a line."""
        what = f"{self.truth} from {self.rival}" if self.rival else f"whether there is {self.truth}"
        known = f"{self.before.power:.0%} with" if self.rival else "not excited by"
        line = f"{what}: {known} the logs at hand"
        return f"{line}; not separable: {self.reason}" if self.reason else f"{line}, {self.after.power:.0%} with this"


@dataclass(frozen=True)
class NextResult:
    """The next recording."""

    verdict: str  # ``designed``, ``nothing left``, or ``not separable``
    pairs: tuple[Verdict, ...]  # which are distinguishable, and which are not
    distinguishable: tuple[str, ...]  # pairs that the recordings at hand distinguish already, in words
    best: Rehearsal | None  # the design; None if there is none
    rate_hz: float  # of its commands, Hz
    joints: tuple[str, ...]  # their names
    tried: int = 0  # designs that were looked at
    beyond: int = 0  # designs that went beyond a limit
    standing: Mapping[str, str] = field(default_factory=dict)  # effects that only feet show -> excitation that would

    @property
    def seconds(self) -> float:
        """Length of the design, s; NaN without one."""
        return round(len(self.best.q) / self.rate_hz, 6) if self.best else math.nan

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values that JSON can hold."""
        design: dict[str, object] | None = None
        if self.best:
            gains = {"kp": self.best.kp.tolist(), "kd": self.best.kd.tolist()}
            design = {**self.best.design.about(self.rate_hz), **gains, "used_of_limits": asdict(self.best.used)}
            design["seconds"] = self.seconds
        pairs = [{**asdict(p), "separable": not p.reason} for p in self.pairs]
        about = {"rate_hz": self.rate_hz, "joints": list(self.joints), "tried": self.tried, "beyond": self.beyond}
        about |= {"settled": [*self.distinguishable], "standing": dict(self.standing)}
        return {"verdict": self.verdict, "design": design, "pairs": pairs, **about}


def model_of(result: GapResult, robot: Robot) -> Theta:
    """Return the values that an answer comes to: what it names, and the rest within tolerance."""
    named = {n.effect: _as_file(n.params) for n in result.named}
    return theta_of(terms_of(composed({e: _as_file(p) for e, p in result.box.items()}, named)), robot.joints)


def _as_file(params: Mapping[str, Mapping[str, float]]) -> dict[str, float | dict[str, float]]:
    """Return values as an effect file has them: a number for one of the robot."""
    return {name: places["robot"] if set(places) == {"robot"} else dict(places) for name, places in params.items()}


def rivals(named: NamedEffect, terms: Sequence[str], robot: Robot) -> list[str]:
    """Return what could be there in the place of a named effect: its equals, then what is known to look like it."""
    felt = tolerances.felt(robot)
    known = tolerances.identification(named.effect).confounded
    others = [name for name in felt if named.effect in tolerances.identification(name).confounded]
    every = dict.fromkeys(chain(named.alias_set, known, others))
    return [name for name in every if name in felt and name not in terms]


def pairs_of(result: GapResult, robot: Robot) -> list[Pair]:
    """Return each named effect with each rival; DesignError if none is named and no recording could mend that."""
    if result.verdict in ("bad log", "unexplained"):
        raise DesignError(
            f"the result is {result.verdict!r}: it names no effect to distinguish from others; "
            "mend the logs, or record more kinds of motion"
        )
    theta = model_of(result, robot)
    terms = [n.effect for n in result.named]
    listed = []
    for named in result.named:
        without = tolerances.without(theta, named.effect, robot.tolerances)
        others = tuple(t for t in terms if t != named.effect)
        spread = _spread(named, robot)
        same = significance.same(max((c.log_gain for c in result.candidates if c.effect == named.effect), default=0.0))
        for rival in rivals(named, terms, robot):
            start = without | _fitted(rival, result.candidates, robot)
            listed.append(Pair(named.effect, rival, theta, start, (*others, rival), spread, same))
    return listed


def unseen(result: GapResult, robot: Robot, moved: Motion) -> list[Pair]:
    """Return what the answer calls not excited and this robot can feel, each against nothing."""
    theta, terms = model_of(result, robot), tuple(n.effect for n in result.named)
    shapes = {v.effect: v.shapes for v in reversed(library(robot, moved))}
    return [
        Pair(effect, "", _probed(effect, theta | shapes.get(effect, {}), robot), theta, terms, 0.0, 0.0)
        for effect in result.not_excited
        if effect in tolerances.felt(robot)
    ]


def _spread(named: NamedEffect, robot: Robot) -> float:
    """Return the relative standard deviation of an effect's size, from its intervals: results keep no draws."""
    shares = []
    for name, places in named.interval.items():
        null = robot.tolerances.param((named.effect, name)).null
        for place, (low, high) in places.items():
            size = abs(named.params[name][place] - null)
            if size > 0.0 and math.isfinite(high - low):
                shares.append((high - low) / (2.0 * thresholds.HALF_WIDTH) / size)
    return min(float(np.median(shares)), WIDEST) if shares else 0.0


def _fitted(effect: str, candidates: Sequence[Candidate], robot: Robot) -> Theta:
    """Return what a search fitted of an effect as a candidate; nothing if it did not, or said no joints."""
    candidate_fits = [c for c in candidates if c.effect == effect and c.params]
    theta: Theta = {}
    for name, given in candidate_fits[0].params.items() if candidate_fits else ():
        p = robot.tolerances.param((effect, name))
        value = np.full(len(robot.joints), p.null) if p.per == "joint" else np.array([p.null])
        at = [robot.joints.index(j) for j in candidate_fits[0].joints if j in robot.joints] if p.per == "joint" else [0]
        if len(np.atleast_1d(given)) == len(at):
            value[at] = given
            theta[effect, name] = value
    return theta


def _probed(effect: str, theta: Theta, robot: Robot) -> Theta:
    """Return values with an effect at all joints, as large as what must not go unseen: twice its tolerances."""
    changed = dict(theta)
    for key in sizes(effect):
        p = robot.tolerances.param(key)
        wide = len(robot.joints) if p.per == "joint" else 1
        changed[key] = np.full(wide, p.null + tolerances.step(p, None, thresholds.PROBE))
    return changed


def attitudes(robot: Robot, comparison: Comparison, settings: DesignSettings) -> list[Attitude]:
    """Return how the base may be held: a Go1 as the settings say, another robot as it was in the recordings."""
    if robot.joints == JOINTS:
        return [Attitude(roll, pitch, held_quat((roll, pitch))) for roll, pitch in settings.hang]
    quats = dict.fromkeys(r.meta.base_quat for r in comparison.recordings)
    return [Attitude(None, None, quat) for quat in quats if quat is not None]


def reason(evaluator: Evaluator, reached: Worth, choice_beyond: int, settings: DesignSettings) -> str:
    """Return why no design separates a pair."""
    best = f"no design reaches more than {reached.power:.0%}"
    if evaluator.pair.rival:
        share = f"all but {1.0 - reached.imitated:.1g}"
        why = f"{evaluator.pair.rival} imitates {share} of what {evaluator.pair.truth} does in the best one"
    else:
        why = f"twice its tolerance changes chi2 by {reached.gain:.2g} per value there"
    fixed = [name for name, kept in (("gains", settings.gains), ("hang", settings.hang)) if len(kept) == 1]
    hints = [f"{' and '.join(fixed)} may not change"] if fixed else []
    hints += [f"{counted(choice_beyond, 'design')} went beyond a limit"] if choice_beyond else []
    return "; ".join([best, why, *hints])


def design(
    result: GapResult,
    recordings: Sequence[Recording],
    robot: RobotConfig | Robot,
    search: GapSettings,
    settings: DesignSettings,
    on_progress: Progress = lambda what, share: None,
    names_only: bool = False,
) -> NextResult:
    """Design the recording that best separates what a result leaves open.

    ``recordings``, ``robot`` and ``search`` are those of the search. With ``names_only`` what the recordings did not
    excite is left out. DesignError if there is nothing that a recording could separate, or none is within the limits.
    NotComparable if the recordings do not suit the robot.
    """
    robot = read_as(robot_from(robot), result).suited(recordings)
    _same_logs(result, recordings)
    pairs, unexcited = pairs_of(result, robot), {} if names_only else result.not_excited
    standing = {effect: how for effect, how in unexcited.items() if effect not in tolerances.felt(robot)}
    rate = recordings[0].meta.rate_hz
    if not pairs and len(standing) == len(unexcited):
        return NextResult("nothing left", (), (), None, rate, robot.joints, standing=standing)
    with one_thread():
        comparison = compare(recordings, robot, search, on_progress)
        targets = [r.joint("q_target") for r in comparison.recordings]
        limits = limits_of(robot, comparison.windows, targets, settings.limits)
        if not comparison.windows.kp.any():
            raise DesignError("gap next designs motions of drives that follow angles; these are commanded torques")
        on_progress("what the recordings at hand separate", 0.1)
        distinguishable: list[str] = []
        evaluators, before = _left(pairs, comparison, result, distinguishable)
        if not evaluators and unexcited:  # which waits until the names are distinguishable
            others = unseen(result, robot, motion(comparison.windows, robot.effort))
            evaluators, before = _left(others, comparison, result, distinguishable)
        if not evaluators:
            known = tuple(distinguishable)
            return NextResult("nothing left", (), known, None, rate, robot.joints, standing=standing)
        stage = Stage(comparison, limits, model_of(result, robot), settings.seconds)
        rate = 1.0 / stage.period
        choice = choose(stage, evaluators, attitudes(robot, comparison, settings), settings, on_progress)
    on_progress("done", 1.0)
    verdicts = _verdicts(evaluators, before, choice, settings)
    verdict = "designed" if choice.best else "not separable"
    known, tried = tuple(distinguishable), (choice.tried, choice.beyond)
    return NextResult(verdict, verdicts, known, choice.best, rate, robot.joints, *tried, standing)


def _left(
    pairs: Sequence[Pair], comparison: Comparison, result: GapResult, distinguishable: list[str]
) -> tuple[list[Evaluator], list[Worth]]:
    """Return the pairs that the recordings at hand leave open, and their worth; note the ``distinguishable`` ones."""
    evaluators, before = list[Evaluator](), list[Worth]()
    for pair in pairs:
        evaluator = Evaluator(pair, comparison.scorer, comparison.settings, COARSE * comparison.dt)
        worth = evaluator.worth(*evaluator.known)
        equal = any(n.effect == pair.truth and pair.rival in n.alias_set for n in result.named)  # in the search
        if worth.power < ENOUGH or equal:
            evaluators.append(evaluator)
            before.append(worth)
        else:
            distinguishable.append(f"{pair.name} (power {worth.power:.0%})")
    return evaluators, before


def _verdicts(
    evaluators: Sequence[Evaluator], before: Sequence[Worth], choice: Choice, settings: DesignSettings
) -> tuple[Verdict, ...]:
    listed = []
    for evaluator, at_hand, after, reached in zip(evaluators, before, choice.worths, choice.reach, strict=True):
        why = "" if after.power >= ENOUGH else reason(evaluator, reached, choice.beyond, settings)
        if why and reached.power >= ENOUGH:
            why = f"another recording would with {reached.power:.0%}; run gap next again after this one"
        listed.append(Verdict(evaluator.pair.truth, evaluator.pair.rival, at_hand, after, why))
    return tuple(listed)


def _same_logs(result: GapResult, recordings: Sequence[Recording]) -> None:
    logs = result.provenance.get("logs")
    if logs and logs != {r.meta.episode: fingerprint(r) for r in recordings}:
        missing = sorted(set(logs) - {r.meta.episode for r in recordings})
        what = f"{', '.join(missing[:3])} missing" if missing else "others, or changed"
        raise DesignError(f"logs: not those of the search ({what}); give the recordings that the result is of")
