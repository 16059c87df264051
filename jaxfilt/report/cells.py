"""What the tables of a page are made of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

NOTHING = "\N{EN DASH}"
"""In a cell whose number is unknown."""

GOOD, BAD, SO_SO, PLAIN = "good", "bad", "so-so", ""
"""How a cell or a verdict is coloured, beside its words."""


class Cell(NamedTuple):
    """What is written, what it is sorted by (a number or a text, None last), and its colour."""

    text: str
    order: float | str | None = None
    mood: str = PLAIN


class Table(NamedTuple):
    """A title, what it says in a sentence, the names of its columns, and rows of cells."""

    title: str
    text: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]


class Card(NamedTuple):
    """A verdict: whose, in a word, in a sentence, the findings, and its colour."""

    name: str
    word: str
    headline: str
    findings: Sequence[str]
    mood: str


def number(value: Any, unit: str = "", digits: int = 4) -> Cell:
    """A number with its unit, sorted by its value."""
    if not is_number(value):
        return Cell(NOTHING)
    return Cell(f"{value:,.{digits}g}".replace("e-0", "e-").replace("e+0", "e+") + (f" {unit}" if unit else ""), value)


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def label(text: str) -> Cell:
    return Cell(text, text)


def estimate(found: dict[str, Any], unit: str = "") -> Cell:
    """Value and standard error, to two digits of the error."""
    value, error = found["value"], found["error"]
    if not is_number(value) or not is_number(error):
        return number(value, unit)
    decimals = 1 - math.floor(math.log10(error)) if error > 0 else 4
    form = f".{max(decimals, 0)}f" if decimals <= 6 else ".2e"
    return Cell(f"{value:,{form}} \N{PLUS-MINUS SIGN} {error:,{form}}" + (f" {unit}" if unit else ""), value)


def ratio(value: Any) -> Cell:
    """A number about 1, to two decimals where that is enough."""
    return Cell(f"{value:.2f}", value) if is_number(value) and 0.1 <= abs(value) < 100 else number(value, digits=3)
