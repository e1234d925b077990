"""The stepwise search: fit what may move, screen, fit the best, test, accept, and again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from go1exp.gap.replay.rows import Theta
from go1exp.gap.result import Candidate
from go1exp.gap.score.likelihood import excess
from go1exp.gap.search import candidates, reduction, significance, single_cause, thresholds, tolerances
from go1exp.gap.search.candidates import Trial, tried
from go1exp.gap.search.fit import Model, fit, misfit
from go1exp.gap.search.screen import Screened, library, motion, outside, rivals, screen
from go1exp.gap.search.state import Search, State
from go1exp.sim.effects.tolerances import sizes

# ---------------------------------------------------------------------- the search


def run(search: Search) -> Search:
    """Return a search that is done."""
    cause = None
    if search.state.machine.on_ground:
        search, cause = alone(search)
    if cause is None and search.within and search.settings.calibrate:
        # Joints that are all off within their tolerances: a fit at states of the nominal model finds a poor optimum.
        search = replace(search, state=replace(search.state, theta=search.within).updated())
    search = fit_nominal(search)
    if cause is not None:
        search.progress(f"fitting the model with {cause.name}", 0.2)
        search = with_term(search, cause)
    on = True
    while on and len(search.state.terms) < search.settings.max_terms:
        search, on = advance(search)
    if search.state.terms:
        search.progress("is all of it needed", 0.85)
        search = reduction.reduced(search)
    sizes_of_terms = [candidates.size(t, search.state.theta, search.state.tolerances) for t in search.state.terms]
    if search.marginal and sizes_of_terms and max(sizes_of_terms) <= thresholds.CLEARLY_BEYOND:
        return search.withdrawn("it leaves its tolerance by too little to be called missing")
    return search


def alone(search: Search) -> tuple[Search, Model | None]:
    """Look for the effect of the whole robot that explains nearly everything alone; return it, if there is one."""
    search, sought = single_cause.cause(search, held_out_test)
    return replace(search, single=sought.best.name if sought.best else "", within=sought.within), sought.best


def with_signals(search: Search) -> Search:
    """Return the search with how much each effect would show (``signal``), and nothing else."""
    search = replace(search, state=search.state.converged(1))
    return noting_signals(search, screened_by(search))


def fit_nominal(search: Search) -> Search:
    """Return the search with the model fitted within its tolerances."""
    search.progress("fitting the model within its tolerances", 0.1)
    state = search.state.converged(3)
    chi2 = state.held_out()
    search = search.with_model(state, chi2, "within tolerances")
    return replace(search, nominal=state.theta, first=excess(chi2))


def advance(search: Search) -> tuple[Search, bool]:
    """Look for one more term, or one more effect to move within its tolerance; return whether to go on."""
    term = len(search.state.terms) + 1
    share = 0.15 + 0.7 * (term - 1) / search.settings.max_terms
    small = excess(search.select_chi2) < search.settings.material
    screened: list[Screened] = []
    if not (small and search.signal):  # all effects, but not where no gap is left and their signals are known
        search.progress(f"screening for term {term}", share)
        screened = screened_by(search)
    search = noting_signals(search, screened)
    search.progress(f"fitting candidates for term {term}", share + 0.06)
    search, fitted = at_active_bounds(search, screened) if small else (search, fitted_candidates(search, screened))
    now = (search.state, search.state.train_chi2, search.select_chi2)
    search, accepted, inside = held_out_test(search, fitted, *now, small)
    if accepted is None and inside is None and not small and excess(search.select_chi2) <= search.settings.adequate:
        # Little is left, and nothing alone removes it: several tolerances may make up for what is missing.
        small = True
        search, fitted = at_active_bounds(search, screened)
        search, accepted, inside = held_out_test(search, fitted, *now, small)
    if accepted is not None:
        search.progress(f"fitting the model with {accepted.name}", share + 0.12)
        search = replace(search, marginal=search.marginal or (small and not search.state.terms))
        return accept(search, accepted)
    if inside is None or len(search.state.relaxed) == thresholds.MOST_RELAXED:
        return search, False
    search.progress(f"fitting the model with {inside.name}", share + 0.12)
    return relaxed(search, inside), True


def accept(search: Search, model: Model) -> tuple[Search, bool]:
    """Make a candidate a term, unless the model is worse with all else refitted; return whether it is one."""
    after = with_term(search, model)
    before = excess(after.state.held_out(search.state.theta))  # by the same floors
    if excess(after.select_chi2) <= before + thresholds.SAME_GAIN:
        return after, True
    return search.rejected([model.name], "with all else fitted again the held-out error grows"), False


def with_term(search: Search, model: Model) -> Search:
    """Return the search with a candidate as a term and all else refitted."""
    terms = (*search.state.terms, model.name)
    others = tuple(name for name in search.state.relaxed if name != model.name)
    # What the box had taken on in place of the effect it gives back: it starts from the nominal values.
    theta = {key: value for key, value in model.theta.items() if key[0] in (*terms, *others)}
    state = replace(search.state, terms=terms, relaxed=others, theta=theta)
    updates, held = state.scorer.updated is not None, not state.machine.on_ground
    if updates and (held or model.name == search.single):
        # Initial states that suit the plain model give the truth twice the floor's chi2 under a loaded link.
        state = state.updated()
    state = state.converged(4)
    if updates:
        state = state.updated().converged(2 if held else 1)
    chi2, plain = state.held_out(), state.held_out(model.theta)
    # With little data, what was fitted from scratch can be a poorer optimum.
    if excess(plain) < excess(chi2) - thresholds.SAME_GAIN:
        state, chi2 = state.at(model.theta), plain
    search = search.measured_again(excess(state.held_out(search.nominal)))  # by the same floors
    return search.with_model(state, chi2, model.name)


def relaxed(search: Search, model: Model) -> Search:
    """Return the search with an effect that may move within its tolerance."""
    names = (*search.state.relaxed, model.name)
    state = replace(search.state, relaxed=names, theta=model.theta).converged(2)
    chi2, base = state.held_out(), len(search.steps)
    without_terms = not search.state.terms
    search = search.with_model(state, chi2, f"{model.name} within its tolerance")
    return replace(search, nominal=state.theta, first=excess(chi2), base=base) if without_terms else search


# ---------------------------------------------------------------------- candidates


def screened_by(search: Search) -> list[Screened]:
    """Rank all ways in which an effect could be missing, on some of the windows of the fit."""
    state = search.state
    linear, machine = state.table, state.machine
    moved = motion(state.scorer.windows, machine.effort)
    variants = library(machine, moved, [*state.terms, *state.relaxed])
    if search.settings.effects:
        variants = [v for v in variants if v.effect in search.settings.effects]
    count, half = len(linear.windows), thresholds.SCREENED_WINDOWS // 2
    # Half of the windows that are looked at are the worst, half are spread evenly.
    worst = np.argsort(-state.scorer.chi2(linear.residual, linear.windows).sum(1))[:half]
    evenly = np.linspace(0, count - 1, min(half, count)).astype(int)
    part = linear.part(np.unique([*worst, *evenly]))
    return screen(state.scorer, state.theta, part, state.may, variants, search.dt)


def noting_signals(search: Search, screened: Sequence[Screened]) -> Search:
    """Return the search with the largest signal of each effect so far."""
    signal = dict(search.signal)
    for s in screened:
        signal[s.variant.effect] = max(signal.get(s.variant.effect, 0.0), s.signal)
    return replace(search, signal=signal)


def at_active_bounds(search: Search, screened: Sequence[Screened]) -> tuple[Search, list[Model]]:
    """Return fitted candidates where the tolerances close the gap: none without an active bound."""
    state = search.state
    within = tolerances.nominal(state.machine)
    relief = tolerances.relief(state.scorer, state.table, state.may)
    values = tolerances.values(state.scorer, state.table)
    wanted = search.settings.effects
    unasked = [e for e in within if wanted and e not in wanted]
    active = tolerances.active_bounds(relief, values, [*state.terms, *unasked])
    missing = outside(screened, within)
    if not active and not missing:
        if not state.terms:  # beside a term they are no rivals of it
            rows = candidates.absorbed(state.keys, relief, state.theta, state.tolerances, search.settings.shortlist)
            search = replace(search, candidates=(*search.candidates, *rows))
        return search, []
    if not active:
        return search, fitted_candidates(search, missing)
    refits = [refitted(state, effect, state.theta) for effect in active]
    taken_for = rivals(screened or screened_by(search), active, within)
    fitted = [refitted(state, s.variant.effect, s.theta, thresholds.RIVAL_ROUNDS) for s in taken_for]
    return search, refits + [replace(m, keys=s.variant.free) for m, s in zip(fitted, taken_for, strict=True)]


def freed(search: Search, effect: str) -> Model:
    """Return the model in which an effect of the tolerance box may leave its tolerance, fitted."""
    state = search.state
    model = Model(effect, state.theta, state.may.also(effect), sizes(effect))
    return fit(state.scorer, [model], state.table, search.settings.iterations, search.dt)[0]


def refitted(state: State, effect: str, theta: Theta, rounds: int = 2) -> Model:
    """Return the model in which an effect may leave its tolerance, and the others begin at their nominal values.

    From several effects that make up for it within their tolerances, a fit of few steps hardly comes away.
    """
    terms = (*state.terms, effect)
    kept = {key: value for key, value in theta.items() if key[0] in (*terms, *state.relaxed)}
    state = replace(state, terms=terms, theta=kept).converged(rounds)
    return Model(effect, state.theta, state.may, sizes(effect), state.train_chi2, state.table.residual)


def fitted_candidates(search: Search, screened: Sequence[Screened]) -> list[Model]:
    """Return models of the best candidates, fitted.

    Where the model is near the data, effects of the tolerance box are also fitted each on its own, and the better fit
    counts. An effect that is easily taken for the best candidate is refitted from nominal values of all else, too.
    """
    state, settings = search.state, search.settings
    chosen: dict[str, Screened] = {}
    for s in screened:
        if len(chosen) < settings.shortlist and s.gain > 0.0:
            chosen.setdefault(s.variant.effect, s)
    models = [Model(effect, s.theta, state.may.also(effect), s.variant.free) for effect, s in chosen.items()]
    fitted = fit(state.scorer, models, state.table, settings.iterations, search.dt) if models else []
    fitted = fitted_on(search, fitted)
    near = excess(search.select_chi2) <= settings.adequate
    movable = {key[0] for key in state.keys} if near else set()
    again = [freed(search, m.name) if m.name in movable else m for m in fitted]
    better = [min(pair, key=misfit) for pair in zip(fitted, again, strict=True)]
    best = min(better, key=misfit).name if better else ""
    return [
        min(m, refitted(state, m.name, m.theta), key=misfit) if tolerances.confounded(m.name, best) else m
        for m in better
    ]


def fitted_on(search: Search, fitted: Sequence[Model]) -> list[Model]:
    """Return candidates, of which those that leave next to nothing are fitted on, if there are several."""
    near = [m for m in fitted if m.chi2 is not None and excess(m.chi2) <= search.settings.adequate]
    if len(near) < 2:
        return [*fitted]
    ended = fit(search.state.scorer, near, search.state.table, search.settings.iterations, search.dt)
    by_name = {m.name: m for m in (*fitted, *ended)}
    return [by_name[m.name] for m in fitted]


# ---------------------------------------------------------------------- held-out tests


def held_out_test(
    search: Search, fitted: Sequence[Model], state: State, train: np.ndarray, select: np.ndarray, small: bool = False
) -> tuple[Search, Model | None, Model | None]:
    """Test fitted candidates on held-out windows, by the chi2 (V, G) of the present model there and in the fit.

    Where the gap is ``small``, the share of it that a candidate removes has no meaning.

    Returns:
        The search, the candidate to accept, and the best of those that help within their tolerances.
    """
    if not fitted:
        return search, None, None
    windows, settings = search.splits.select, search.settings
    trial = tried(state.scorer, settings, fitted, train, select, windows, search.dt, search.rng, small)
    alias = sorted(np.flatnonzero(trial.alias).tolist(), key=lambda k: -trial.mean[k])
    names = tuple(fitted[k].name for k in alias)
    search = replace(search, candidates=(*search.candidates, *_evidence(search, trial, fitted, names)))
    helps = [k for k in range(len(fitted)) if trial.helps[k] and trial.sizes[k] <= 1.0]
    inside = fitted[max(helps, key=lambda k: trial.mean[k])] if helps else None
    if trial.chosen is None:
        return search, None, inside
    accepted = fitted[trial.chosen]
    if not search.state.terms:
        near = trial.mean > thresholds.EQUAL_SHARE * trial.mean[trial.chosen]
        order = [k for k in np.argsort(-trial.mean) if near[k] and trial.sizes[k] > 1.0 and k != trial.chosen]
        search = replace(search, rivals=tuple(fitted[k] for k in order[: thresholds.RIVALS]))
    on_train = significance.gains(train, np.stack([m.chi2 for m in fitted if m.chi2 is not None]))
    every = np.concatenate([on_train, trial.gain], axis=1)
    share = _bootstrap_share(search, every[~trial.aside], trial.alias[~trial.aside])
    equals = (accepted.name, *(n for n in names if n != accepted.name))
    aliases, shares = {**search.aliases, accepted.name: equals}, {**search.shares, accepted.name: share}
    return replace(search, aliases=aliases, shares=shares), accepted, inside


def _evidence(search: Search, trial: Trial, fitted: Sequence[Model], aliases: tuple[str, ...]) -> list[Candidate]:
    """Return the candidates of a trial as they are reported, best first."""
    rows = []
    for k in np.argsort(-trial.mean):
        status, reason = trial.reason(int(k))
        rows.append(
            candidates.candidate(
                fitted[k],
                search.state.scorer.windows.joints,
                excess_after=trial.after[k],
                log_gain=float(trial.mean[k]),
                p=float(trial.p[k]),
                alias_class=aliases if trial.alias[k] else (fitted[k].name,),
                status=status,
                reason=reason,
                stage=len(search.state.terms) + 1,
            )
        )
    return rows


def _bootstrap_share(search: Search, gain: np.ndarray, alias: np.ndarray) -> float:
    """Return the share of bootstraps in which the chosen candidate, or its equal (``alias``), gains most."""
    state, count = search.state, search.settings.bootstraps
    episode = state.scorer.windows.episode[np.concatenate([search.splits.train, search.splits.select])]
    episode = np.repeat(episode, len(state.machine.groups))
    wins = 0
    for _ in range(count):
        picked = significance.resampled(episode, search.rng)
        mean = gain[:, picked].mean(axis=1)
        close = mean >= mean.max() - significance.same(mean.max())
        wins += bool(close[alias].any())
    return wins / max(count, 1)
