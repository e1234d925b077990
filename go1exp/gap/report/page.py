"""The page of a comparison, its JSON file, and the summary for a terminal."""

from __future__ import annotations

import json
import math
import textwrap
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

import go1exp.gap.report.figures as figures
import go1exp.gap.report.tables as tables
import go1exp.gap.report.words as words
from go1exp.base.files import write_text
from go1exp.base.report.page import Block, Card, Content, Page, Section, render
from go1exp.base.report.table import NOTHING, Table, aligned, number, share
from go1exp.gap.report.tables import short
from go1exp.gap.result import GapResult, Localisation, NamedEffect
from go1exp.gap.search import clocks

MOST_WINDOWS = 6  # windows that are drawn, so that the page stays small; the JSON file has all
MOST_FORESTS = 16  # parameters that are drawn; the table has all


def write_report(result: GapResult, folder: Path) -> list[Path]:
    """Write ``report.html`` and ``report.json`` (``GapResult.as_dict``) into a folder, made if missing; return both."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    plain = json.dumps(result.as_dict(), indent=1, allow_nan=False, default=str)
    files = [folder / "report.html", folder / "report.json"]
    for file, content in zip(files, (page(result), plain + "\n"), strict=True):
        write_text(file, content)
    return files


def page(result: GapResult) -> str:
    """Return the page, one HTML document."""
    cards = [*(_effect(result, n) for n in result.named), *_errors(result), *_angles(result), *_clock(result)]
    return render(
        Page(
            title=f"go1exp gap: {result.verdict}",
            kind=f"go1exp gap · verdict (exit code {result.exit_code})",
            heading=result.verdict.capitalize(),
            lead=result.sentence,
            cards=[*cards, Card("What would change the verdict", points=words.would_change(result))],
            warnings=result.warnings,
            sections=[
                _overlays(result),
                _localisation(result),
                _section("Evidence", _evidence(result), "No candidate was tried.", EVIDENCE, "evidence"),
                _section(FALL, figures.waterfall(result), "No steps.", name="waterfall-section"),
                *_parameters(result),
                _section(STABILITY, figures.bootstraps(result), "Nothing was resampled.", RESAMPLED, "stability"),
                *_next(result),
                *_provenance(result),
            ],
            tone=f"is-{result.verdict.replace(' ', '-')}",
        )
    )


# ---------------------------------------------------------------------- cards


def _effect(result: GapResult, named: NamedEffect) -> Card:
    rivals = words.rivals(named)
    sizes = [
        (f"{name} {mean}", f"{spread}; ± is the mean half width of the 95 % intervals" if spread else "")
        for name, mean, spread in words.sizes(named)
    ]
    notes = []
    if rivals:
        notes.append(f"Not distinguishable from {' or '.join(rivals)} with these data.")
    if named.effect in result.bootstrap_share:
        notes.append(f"selected in {share(result.bootstrap_share[named.effect])} of bootstrap resamples")
    return Card(
        title=" or ".join((named.effect, *rivals)),
        tag=named.status,
        note=words.meaning(named.effect),
        sizes=[
            ("", words.place(named.effect, named.joints, words.everyone(result))),
            *(sizes or [("", "not significantly beyond its tolerance at any single joint")]),
        ],
        notes=notes,
    )


def _errors(result: GapResult) -> list[Card]:
    rows = [list(pair) for pair in words.errors(result)]
    if not rows:
        return []
    if result.closed == result.closed:
        rows.append(["explained share", share(result.closed)])
    note = (
        "Chi2 per sample, normalised by the noise: a correct model scores 1, the noise level. A model is adequate up to"
        f" {number(1.0 + words.limit(result, 'adequate'))}. Windows beyond ten times the noise level enter by their"
        " logarithm, so that outliers do not dominate."
    )
    return [Card("Held-out error", "(normalised chi2)", table=Table("", [], rows), notes=[note])]


def _angles(result: GapResult) -> list[Card]:
    if result.errors is None:
        return []
    table = Table("", ["", "nominal", "fitted"], words.angle_rows(result.errors))
    notes = ["Medians over windows, by joint and by episode."]
    return [Card("Joint angles", "(mrad, held-out)", note=words.angles(result.errors), table=table, notes=notes)]


def _clock(result: GapResult) -> list[Card]:
    if result.clock is None:
        return []
    rows = words.clock_rows(result.clock)
    header = ["", "rows, Hz", "within tolerances, mrad", "with first terms, mrad", "first terms"]
    note = "Errors of the angles in the median held-out window of the same rows, and the first terms, by each clock."
    table = Table("", header, rows) if rows else None
    return [Card("Clock", "(time between rows)", note=clocks.sentence(result.clock), table=table, notes=[note])]


# ---------------------------------------------------------------------- sections

FALL, STABILITY = "From the nominal model to the noise level", "Stability over bootstrap resamples"
RESAMPLED = "Share of resampled episode sets that select the effect. Hatched: below the threshold of certification."
EVIDENCE = (
    "Every fitted candidate, best first, on held-out windows. Log gain: mean decrease of log chi2. p: sign-flip test,"
    " corrected for the number of candidates. Tolerances: largest deviation from null, in tolerances."
)
LOCALISATION = (
    "Mean of normalised chi2 - 1 by joint and regime on held-out samples. Framed and bold: significant at a false"
    " discovery rate of 5 % (block permutation)."
)


def _section(title: str, blocks: Content, nothing: str, note: str = "", name: str = "") -> Section:
    """Return a section with its note; without blocks it says that there is ``nothing``."""
    return Section(title, blocks or [Block(nothing)], note if blocks else "", name)


def _evidence(result: GapResult) -> list[Table]:
    return [tables.evidence(result)] if result.candidates else []


def _overlays(result: GapResult) -> Section:
    windows = [w for w in result.overlays[:MOST_WINDOWS] if len(w.t) and figures.rows_of(w)]
    drawn = [figures.overlay(window, f"window{k}") for k, window in enumerate(windows)]
    trunk = any(words.TRUNK_UNITS.keys() & figures.rows_of(window) for window in windows)
    note = (
        "From the worst window of the nominal model to its median one: the joints with the largest error of the nominal"
        f" model{', and the measurements of the IMU' if trunk else ''}. Small panels: model - measurement in standard"
        " deviations of the noise, linear up to 3 and logarithmic beyond; the grey band is ± 2."
    )
    hidden = len(result.overlays) - len(windows)
    rest = [Block(f"{hidden} more in report.json.")] if hidden and drawn else []
    title = "Nominal and fitted model on held-out windows"
    return _section(title, [*drawn, *rest], "No curves were kept.", note, "overlays")


def _localisation(result: GapResult) -> Section:
    maps = tables.heat_maps(result)
    section = _section("Location of the model error", maps, "Nothing was compared.", LOCALISATION, "localisation")
    return replace(section, grid=True, key=tables.scale(result)) if maps else section


def _parameters(result: GapResult) -> list[Section]:
    drawn = [(n, name) for n in result.named for name, values in n.params.items() if values][:MOST_FORESTS]
    forests = [figures.forest(result, n, name, k) for k, (n, name) in enumerate(drawn)]
    values, box = tables.values(result), figures.box(result)
    note = "Points: fitted values; bars: 95 % intervals over resampled episodes; dotted: null; grey: its tolerance."
    if not values.rows:
        return [Section("Parameters", [Block("No effect is identified."), *box], name="parameters")]
    return [Section("Parameters", forests, note, "parameters", grid=True), Section("", [values, *box])]


def _next(result: GapResult) -> list[Section]:
    recordings = words.next_recordings(result)
    note = (
        "Each command simulates the recording with the model of this project, to check its value beforehand; drive the"
        " robot through the same targets (q_target in its files)."
    )
    blocks: list[Block | Table] = []
    for todo in recordings:
        effects = f" ({', '.join(todo.effects)})" if todo.effects else ""
        blocks += [Block(f"{todo.why}{effects}"), Block(todo.command, fixed=True)]
    if not recordings:
        unknown = "Unknown: the logs are not usable." if result.verdict == "bad log" else "Nothing."
        blocks += [Block(unknown), *map(Block, result.advice)]
    if result.not_excited:
        rows = [[effect, words.meaning(effect), excitation] for effect, excitation in result.not_excited.items()]
        blocks.append(Table("", ["effect", "meaning", "excitation"], rows))
    return [Section("Not identifiable from these logs; next recordings", blocks, note if recordings else "", "next")]


def _provenance(result: GapResult) -> list[Section]:
    floors, origin = tables.floors(result), tables.provenance(result)
    measured = [floors] if floors else []
    first = _section("Noise levels and provenance", measured, "No noise levels were measured.", name="provenance")
    return [first, Section("", origin, grid=True)] if origin else [first]


WIDTH = 100

MOST_EPISODES = 6  # listed episodes, those with the largest residual; the page has all


def text(result: GapResult, status: int | None = None) -> str:
    """Return the summary for a terminal: plain text without markup, lines of up to 100 characters but for commands."""
    code = result.exit_code if status is None else status
    lines = [f"{result.verdict.upper()} (exit code {code})", *_wrapped(result.sentence), ""]
    if result.named:
        head = ("effect", "where", "value", "95 % interval", "status", "bootstraps")
        lines += [*aligned([head, *_rows(result)], len(head), "  "), ""]
    if result.excess:
        lines += aligned([("held-out error", "normalised chi2 (1 = noise level)"), *words.errors(result)], 2, "  ")
        if not math.isnan(result.closed):
            lines.append(f"{share(result.closed)} of the excess chi2 is explained.")
        lines.append("")
    if result.errors is not None:
        title = ("angle error, mrad", "nominal", "fitted")
        rows = words.angle_rows(result.errors, MOST_EPISODES)
        lines += [*_wrapped(words.angles(result.errors)), "", *aligned([title, *rows], 3, "  "), ""]
    for todo in words.next_recordings(result):
        lines += [*_wrapped(f"Next: {todo.why}"), f"  {todo.command}"]
    lines += [line for warning in result.warnings for line in _wrapped(f"Warning: {warning}")]
    return "\n".join(lines).strip() + "\n"


def localisation_text(where: Localisation) -> str:
    """Return a table of chi2 - 1 by joint and regime for a terminal, ``*`` if significant; none without samples."""
    shown = [r for r in range(len(where.regimes)) if where.samples[:, r].any()]
    titles = [textwrap.wrap(where.regimes[r], 9, break_long_words=False) for r in shown]
    deep = max((len(title) for title in titles), default=0)
    head = zip_longest(*([""] * (deep - len(title)) + title for title in titles), fillvalue="")
    rows = [("", *line) for line in head]
    for j, joint in enumerate(where.joints):
        cells = (short(float(where.excess[j, r])) + ("*" if where.flagged[j, r] else " ") for r in shown)
        rows.append((joint, *cells))
    title = "Mean of normalised chi2 - 1 by joint and regime; 0 = noise level, * significant."
    return "\n".join([title, *aligned(rows, len(rows[0]), "  ")]) + "\n"


def _rows(result: GapResult) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for named in result.named:
        at = words.place(named.effect, named.joints, words.everyone(result))
        stable = share(result.bootstrap_share.get(named.effect, math.nan))
        name = " or ".join((named.effect, *words.rivals(named)))
        every = words.sizes(named)
        if not every:
            rows.append((name, at, NOTHING, NOTHING, named.status, stable))
        for k, (parameter, mean, _) in enumerate(every):
            pairs = named.interval.get(parameter, {}).values()
            interval = NOTHING
            if pairs:
                low, high = min(a for a, _ in pairs), max(b for _, b in pairs)
                interval = f"{number(low)} to {number(high)}"
            first = (name, at) if k == 0 else ("", "")
            last = (named.status, stable) if k == 0 else ("", "")
            rows.append((*first, f"{parameter} {mean}", interval, *last))
    return rows


def _wrapped(sentence: str) -> list[str]:
    return textwrap.wrap(" ".join(sentence.split()), WIDTH, break_long_words=False, break_on_hyphens=False)
