"""Writes the page of the verbs from what the command line itself says, so that it cannot drift."""

from __future__ import annotations

import contextlib
import html
import io
import os
import re
from typing import Any
from unittest import mock

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from depthba.cli import VERBS, main

PAGE = "verbs.md"
HEAD = """# Verbs

What `depthba VERB --help` says, made from the command line's own parser.

Every verb takes `--help`. With `--json` stdout holds one JSON object and nothing else; progress and
notes go to stderr. Exit status: 0 done; 1 a known error, one line on stderr; 2 wrong usage;
3 finished, but not to be trusted; 130 ended by Ctrl-C. `--config FILE` reads defaults from a YAML
file, such as the `config.yaml` of a run; the command line wins over the file.
"""
ROW = re.compile(r"^(?P<name>\S(?:.*?\S)?)(?:  +(?P<text>.*))?$")


def on_files(files: Files, config: MkDocsConfig, **_: Any) -> Files:
    """Add the page."""
    files.append(File.generated(config, PAGE, content=page()))
    return files


def page() -> str:
    """Return the page as Markdown."""
    rows = [f"| [`{name}`](#{name}) | {verb.help} |" for name, verb in VERBS.items()]
    parts = [HEAD, "| verb | does |\n|---|---|\n" + "\n".join(rows) + "\n"]
    return "\n".join([*parts, *(section(name) for name in VERBS)])


def section(verb: str) -> str:
    """Return the section of a verb: what it is, how it is called, what it takes."""
    about, *panels = re.split(r"^╭─ ", help_of(verb), flags=re.MULTILINE)
    usage, _, text = about.partition("\n\n")
    lines = [f"## {verb} {{ #{verb} }}", "", "```text", usage.removeprefix("usage: "), "```", ""]
    lines.append(escaped(text.strip()))
    for panel in panels:
        head, *rest = panel.splitlines()
        inner = [line[2:-1].rstrip() for line in rest if line.startswith("│")]
        lines += ["", f"**{head.rstrip('─╮ ').capitalize()}**", "", *described(inner)]
    return "\n".join(lines) + "\n"


def described(lines: list[str]) -> list[str]:
    """Return the Markdown of a panel: a paragraph, where there is one, and a row per argument."""
    rule = next((k for k, line in enumerate(lines) if set(line) == {"─"}), -1)
    out = [escaped(line) for line in lines[: max(rule, 0)]]
    for line in lines[rule + 1 :]:
        row = ROW.match(line)
        if row is not None:
            out += ["", f"`{row['name']}`", f":   {escaped(row['text'] or '')}"]
        else:
            out[-1] += " " + escaped(line.strip())
    return out


def escaped(text: str) -> str:
    """Return text with what HTML and Markdown would take for their own made harmless."""
    kept = re.split(r"(`[^`]*`)", text)
    return "".join(
        part
        if part.startswith("`")
        else re.sub(r"([*_|])", r"\\\1", html.escape(part, quote=False))
        for part in kept
    )


def help_of(verb: str) -> str:
    """Return the help of a verb as a terminal shows it."""
    out = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    with (
        mock.patch.dict(os.environ, {"COLUMNS": "100", "NO_COLOR": "1"}),
        contextlib.redirect_stdout(out),
        contextlib.suppress(SystemExit),
    ):
        main([verb, "--help"])
    out.seek(0)
    return out.read()
