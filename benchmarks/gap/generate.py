"""Write sealed cases: ``python -m benchmarks.gap.generate out=DIR kinds=null,single n=10 seed=123``.

Each case is a folder of recordings under ``out``; ``out/known.json`` says what the solver may know. The answers go to a
file of their own, whose SHA-256 is written to ``out/SEAL`` and printed before anything is simulated: publish it, run
the solver, then show the answers. An interrupted run is continued by the same command. ``signals=DIR`` also simulates
each robot without its effect and writes how many times the noise the angles change; that doubles the time.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import json
import shutil
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gap import cases, known, logger
from benchmarks.gap.damage import damage, truncate
from benchmarks.gap.simulate import simulate
from go1exp.logs.recording import Recording


def recordings(case: cases.Case) -> list[Recording]:
    """Simulate a case and return what its logger wrote (damaged, if it is that kind)."""
    world, noise, harm = ([*case.seed, k] for k in range(3))
    samples = simulate(case.truth, case.episodes, case.dt, np.random.default_rng(world), case.on)
    rng = np.random.default_rng(noise)
    whole = [
        Recording(logger.meta(e), logger.log(case.logger, samples, k, e.target, e.on, rng))
        for k, e in enumerate(case.episodes)
    ]
    return damage(whole, case.damage, np.random.default_rng(harm)) if case.damage else whole


def write_case(case: cases.Case, out: Path, signals: Path | None = None) -> None:
    """Write a case's folder, whole or not at all; and how much its effect shows to a file in ``signals``."""
    if signals is not None:
        signals.mkdir(parents=True, exist_ok=True)
        (signals / f"{case.name}.json").write_text(json.dumps({"signal": signal(case)}) + "\n")
    partial = out / f".{case.name}.part"
    shutil.rmtree(partial, ignore_errors=True)
    logger.save(partial, recordings(case))
    if case.damage == "truncated":
        for k, file in enumerate(sorted(partial.glob("*.parquet"))):
            if k % 3 == 1:
                truncate(file, 0.6)
    partial.rename(out / case.name)


def signal(case: cases.Case) -> float:
    """Return how much a case's effect shows: RMS change of the angles against a robot without it, over the noise."""
    world = [*case.seed, 0]
    a, b = (
        simulate(t, case.episodes, case.dt, np.random.default_rng(world), case.on) for t in (case.truth, case.without)
    )
    return float(np.sqrt(np.mean((a.q - b.q) ** 2)) / case.logger.q_noise)


def seal(answers: dict[str, Any]) -> tuple[bytes, str]:
    """Return the answers as they are written, and their SHA-256."""
    text = (json.dumps(answers, indent=1, sort_keys=True) + "\n").encode()
    return text, hashlib.sha256(text).hexdigest()


def settings(arguments: Sequence[str]) -> argparse.Namespace:
    """Read ``key=value`` arguments."""
    usual: dict[str, Any] = {
        "out": None,
        "kinds": ",".join(cases.KINDS),
        "n": 10,
        "seed": None,
        "episodes": 8,
        "seconds": 5.0,
        "effects": "",
        "sizes": ",".join(f"{size:g}" for size in cases.SIZES),
        "answers": None,
        "jobs": 1,
        "signals": None,
    }
    words = (
        "usage: python -m benchmarks.gap.generate out=DIR seed=INT [kinds=null,single] [n=10] [episodes=8] "
        "[seconds=5] [effects=coulomb,lag] [sizes=1,2,5] [answers=FILE] [signals=DIR] [jobs=1]\n"
        f"kinds: {', '.join(cases.KINDS)}\n"
        f"effects (of single and pair): {', '.join(known.LIBRARY)}"
    )
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key not in usual or not value:
            raise SystemExit(f"{argument!r}: no such setting\n{words}")
        try:
            usual[key] = {"n": int, "seed": int, "episodes": int, "seconds": float, "jobs": int}.get(key, str)(value)
        except ValueError:
            raise SystemExit(f"{argument!r}: not a number\n{words}") from None
    if usual["out"] is None or usual["seed"] is None:
        raise SystemExit(words)
    chosen = argparse.Namespace(**usual)
    chosen.out = Path(chosen.out)
    chosen.answers = Path(chosen.answers) if chosen.answers else chosen.out.with_name(chosen.out.name + ".answers.json")
    chosen.signals = Path(chosen.signals) if chosen.signals else None
    chosen.kinds = tuple(chosen.kinds.split(","))
    try:
        chosen.sizes = tuple(float(size) for size in chosen.sizes.split(","))
    except ValueError:
        raise SystemExit(f"sizes={chosen.sizes}: not numbers\n{words}") from None
    chosen.effects = tuple(e for e in chosen.effects.split(",") if e)
    for name, allowed in [*((k, cases.KINDS) for k in chosen.kinds), *((e, known.LIBRARY) for e in chosen.effects)]:
        if name not in allowed:
            raise SystemExit(f"{name!r}: must be one of {', '.join(allowed)}")
    if chosen.episodes < 2 or chosen.seconds <= 0 or chosen.n < 1:
        raise SystemExit("episodes must be at least 2, seconds more than 0, n at least 1")
    for secret in (chosen.answers, chosen.signals):
        if secret and chosen.out in (secret, *secret.parents):
            raise SystemExit(f"{secret}: must not lie beside the cases, where a solver reads")
    return chosen


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw, seal and simulate."""
    s = settings(sys.argv[1:] if arguments is None else arguments)
    todo = cases.plan(
        s.kinds, s.n, lambda kind, index: cases.make(kind, index, s.seed, s.episodes, s.seconds, s.effects, s.sizes)
    )
    text, digest = seal({case.name: case.answer for case in todo})
    mark = s.out / "SEAL"
    if mark.is_file() and mark.read_text().split()[0] != digest:
        raise SystemExit(f"{s.out}: holds a benchmark made with other settings; take another folder")
    s.out.mkdir(parents=True, exist_ok=True)
    s.answers.parent.mkdir(parents=True, exist_ok=True)
    s.answers.write_bytes(text)
    mark.write_text(f"{digest}  {s.answers.name}\n")
    (s.out / "known.json").write_text(
        json.dumps({"nominal": known.NOMINAL, "tolerances": known.TOLERANCES, "library": known.LIBRARY}, indent=1)
        + "\n"
    )
    print(f"sealed {len(todo)} cases: sha256 {digest} of {s.answers}", flush=True)
    left = [case for case in todo if not (s.out / case.name).is_dir()]
    begun = time.monotonic()
    with ProcessPoolExecutor(s.jobs) if s.jobs > 1 else _InTurn() as pool:
        for done, _ in enumerate(pool.map(functools.partial(write_case, out=s.out, signals=s.signals), left), start=1):
            each = (time.monotonic() - begun) / done
            print(f"case {done}/{len(left)}: {each:.1f} s each, {each * (len(left) - done):.0f} s left", flush=True)
    print(f"{len(todo)} cases in {s.out}", flush=True)


class _InTurn:
    """One after the other, in this process."""

    map = staticmethod(map)

    def __enter__(self) -> _InTurn:
        return self

    def __exit__(self, *_: object) -> None:
        pass


if __name__ == "__main__":
    main()
