"""The site: whole, offline, its formulas drawn and its verbs as the command line has them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

from depthba.cli import VERBS
from tests.docs.pages import ROOT

pytest.importorskip("material", reason="the extra docs is not installed")

REMOTE = re.compile(r"^(https?:)?//")


class Fetched(HTMLParser):
    """Collects what a browser fetches by itself when it shows a page."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if tag in ("script", "img", "iframe", "source", "video") and (src := found.get("src")):
            self.addresses.append(src)
        if tag == "link" and found.get("rel") != "canonical" and (href := found.get("href")):
            self.addresses.append(href)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", out]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}  # the theme's news of its successor
    done = subprocess.run(command, cwd=ROOT, env=quiet, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return out


def test_no_page_fetches_anything_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 15
    for page in pages:
        fetched = Fetched()
        fetched.feed(page.read_text(encoding="utf-8"))
        assert fetched.addresses
        for address in fetched.addresses:
            assert not REMOTE.match(address), f"{page.name}: {address}"
    for sheet in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*[\"']?(https?:)?//", sheet.read_text()), sheet


def test_every_page_is_in_the_menu(site: Path) -> None:
    menu = (site / "index.html").read_text(encoding="utf-8")
    for page in ROOT.glob("docs/*.md"):
        assert page.stem == "index" or f'href="{page.stem}.html"' in menu, page.name


def test_formulas_are_mathml_without_what_was_not_understood(site: Path) -> None:
    text = (site / "theory.html").read_text(encoding="utf-8")
    formulas = re.findall(r"<math .*?</math>", text, re.DOTALL)
    assert len(formulas) > 40
    assert "arithmatex" in text and "\\(" not in text and "\\[" not in text
    for formula in formulas:
        assert "\\" not in formula and "<mo>&amp;</mo>" not in formula, formula


def test_every_verb_is_there_with_its_options(site: Path) -> None:
    text = (site / "verbs.html").read_text(encoding="utf-8")
    for verb in VERBS:
        assert f'id="{verb}"' in text
    for option in ("--roi FLOAT FLOAT FLOAT FLOAT FLOAT FLOAT", "--against RUN", "--start-error"):
        assert option in text
    assert "╭" not in text and "{None}|" not in text
