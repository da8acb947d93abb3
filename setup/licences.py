"""Lists the licence of every package that an installation with all extras brings, and judges it.

``python setup/licences.py`` prints a table. The status is 1 where a licence does not fit ours (MIT)
or none is told, and nobody has looked at it: then it belongs into `SEEN`, with the reason.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]

FITS = re.compile(
    r"\b(MIT(-CMU)?|BSD|0BSD|Apache|ISC|PSF|Python Software Foundation|MPL|Mozilla|Zlib|CC0|"
    r"Unlicense|HPND)\b",
    re.IGNORECASE,
)
"""Licences under which a package may be depended on by one under MIT. MPL binds its own files."""
BINDS = re.compile(r"(?<!L)GPL|Affero|SSPL|Commercial|Proprietary|NonCommercial|CC-BY-NC", re.I)
"""What would bind us, or whom we give it to."""

SEEN = {
    "atheris": "Apache-2.0, after its repository; dev alone; its metadata say nothing",
    "evo": "GPL-3.0; dev alone: an outside check in tests, imported by nothing that is shipped",
    "genicam": "the GenICam licence, which lets binaries be passed on; cameras alone, optional",
    "apsw": "any that OSI has approved, so zlib; used by rosbags",
    "embreex": "MIT, after its repository; its metadata hold a line of the text alone",
    "cycler": "BSD-3-Clause, after the text in its metadata",
}
"""Packages whose metadata do not settle it, or whose licence does not fit; why they may stay."""


def name_of(text: str) -> str:
    """Return a package's name as indexes compare it."""
    return re.sub(r"[-_.]+", "-", text).lower()


def brought() -> dict[str, metadata.Distribution | None]:
    """Return what an installation with all extras brings on this machine; None: not installed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = list(project["dependencies"])
    for extra in project["optional-dependencies"].values():
        wanted += extra
    found: dict[str, metadata.Distribution | None] = {}
    done: set[tuple[str, str]] = set()
    todo = [(Requirement(text), "") for text in wanted]
    while todo:
        requirement, of_extra = todo.pop()
        if requirement.marker and not requirement.marker.evaluate({"extra": of_extra}):
            continue
        name = name_of(requirement.name)
        for extra in ("", *requirement.extras):
            if (name, extra) in done:
                continue
            done.add((name, extra))
            try:
                found[name] = metadata.distribution(name)
            except metadata.PackageNotFoundError:
                found[name] = None
                continue
            todo += [(Requirement(text), extra) for text in found[name].requires or ()]
    return found


def licence(package: metadata.Distribution) -> str:
    """Return what a package's metadata say of its licence, in a few words."""
    told = package.metadata
    if expression := told.get("License-Expression"):
        return str(expression)
    classes = [c for c in told.get_all("Classifier") or [] if c.startswith("License ::")]
    if classes:
        return ", ".join(c.rpartition(" :: ")[2] for c in classes)
    text = (told.get("License") or "").strip()
    return text.splitlines()[0][:60] if text else ""


def judged() -> Iterator[tuple[str, str, str, str]]:
    """Give name, version, licence and, where it may not stay, what is wrong."""
    for name, package in sorted(brought().items()):
        if package is None:
            yield name, "", "", "not installed, so nobody knows"
            continue
        told = licence(package)
        fits = bool(FITS.search(told)) and not BINDS.search(told)
        wrong = "" if fits or name in SEEN else f"{told or 'no licence'} does not fit MIT"
        yield name, package.version, SEEN.get(name, told), wrong


def main() -> int:
    """Print the table; 1 where something is wrong."""
    status = 0
    for name, version, told, wrong in judged():
        print(f"{name:28} {version:18} {told}")
        if wrong:
            print(f"licences: {name}: {wrong}", file=sys.stderr)
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main())
