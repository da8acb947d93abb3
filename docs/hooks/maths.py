"""Turns the formulas of a page into MathML while the site is built: browsers draw it unaided."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\[(\[](?P<tex>.*?)\\[)\]]</(?P=tag)>', re.DOTALL
)


def on_page_content(content: str, **_: Any) -> str:
    """Replace what arithmatex marked in a page by MathML."""
    return FORMULA.sub(_mathml, content)


def _mathml(match: re.Match[str]) -> str:
    tag, tex = match["tag"], html.unescape(match["tex"]).strip()
    display = "inline" if tag == "span" else "block"
    return f'<{tag} class="arithmatex">{convert(tex, display=display)}</{tag}>'
