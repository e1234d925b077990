"""The page of every report: one HTML document from one template, which needs no network and no other file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from go1exp.base.report.plots import Drawing
from go1exp.base.report.table import Table


@dataclass(frozen=True)
class Card:
    """One box in the head of a page.

    Attributes:
        title: first line, and ``soft`` its addition in grey.
        soft: addition to the title.
        tag: status beside the title.
        note: text below the title.
        sizes: large values with a note each.
        table: table in the box.
        points: list items.
        notes: text at the end.
    """

    title: str
    soft: str = ""
    tag: str = ""
    note: str = ""
    sizes: Sequence[tuple[str, str]] = ()
    table: Table | None = None
    points: Sequence[str] = ()
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Block:
    """Text of a section: a paragraph, or a command or settings in a fixed-width font."""

    text: str
    fixed: bool = False


Content = Sequence[Block | Table | Drawing]


@dataclass(frozen=True)
class Section:
    """One section of a page.

    Attributes:
        title: heading; empty continues the section above.
        blocks: text, tables and drawings in order.
        note: explanation below the heading.
        name: anchor of the section.
        grid: whether the blocks stand side by side where the screen is wide.
        key: legend of a heat map: label, fill and ink of each level.
    """

    title: str
    blocks: Content = ()
    note: str = ""
    name: str = ""
    grid: bool = False
    key: Sequence[tuple[str, str, str]] = ()


@dataclass(frozen=True)
class Page:
    """Content of a page.

    Attributes:
        title: of the document.
        kind: line above the heading.
        heading: first heading.
        lead: sentence below the heading.
        sections: content.
        verdicts: words with the names that they are about.
        facts: remarks in the head.
        warnings: warnings in the head.
        cards: boxes in the head.
        tone: class that colours the head.
    """

    title: str
    kind: str
    heading: str
    lead: str
    sections: Sequence[Section]
    verdicts: Sequence[tuple[str, str]] = ()
    facts: Sequence[str] = ()
    warnings: Sequence[str] = ()
    cards: Sequence[Card] = field(default_factory=list)
    tone: str = ""


def render(page: Page) -> str:
    """Return the HTML document of a page."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html.j2").render(page=page)


def sections(tables: Sequence[Table], drawings: Sequence[Drawing]) -> list[Section]:
    """Return a section per table, and the plots after the first table."""
    parts = [Section(t.title, [Table("", t.header, t.rows, look=t.look)], note=t.note) for t in tables]
    plots = [Section("Plots", drawings, grid=True)] if drawings else []
    return [*parts[:1], *plots, *parts[1:]]


def provenance(notes: Sequence[str], settings: Mapping[str, object]) -> Section:
    """Return the last section: methods, and the settings as YAML."""
    plain = json.loads(json.dumps(settings, default=str))
    text = yaml.safe_dump(plain, default_flow_style=None, sort_keys=False, width=100, allow_unicode=True).strip()
    return Section("Methods and settings", [*map(Block, notes), Block(text, fixed=True)])
