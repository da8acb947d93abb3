"""`depthba review [RUN...]`: what happened in there?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from depthba.verbs import DONE, WRONG_USAGE
from depthba.verbs.output import note, print_json
from eval import review


@dataclass(frozen=True)
class Arguments:
    """Open the recordings of runs in the Rerun viewer."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")] = ()
    """Run folders. None: the newest run, logs/latest."""
    web: bool = False
    """Serve to a browser, on 127.0.0.1 alone, in place of opening a window."""
    port: int | None = None
    """Port for --web. None: a free one."""
    screenshot: Path | None = None
    """Write a picture of the viewer to this PNG; needs no screen, takes up to a minute."""
    json: bool = False
    """Print one JSON object on stdout and nothing else there."""


def run(arguments: Arguments) -> int:
    """Show the recordings; return the exit status."""
    if arguments.web and arguments.screenshot is not None:
        note("depthba review: --web and --screenshot exclude each other")
        return WRONG_USAGE
    files = review.recordings(arguments.runs)
    if arguments.json:
        shot = arguments.screenshot
        told = {"recordings": [str(f) for f in files], "screenshot": str(shot) if shot else None}
        print_json(told)
    if arguments.screenshot is not None:
        review.screenshot(files, arguments.screenshot)
        if not arguments.json:
            print(arguments.screenshot)
    elif arguments.web:
        review.serve(files, arguments.port)
    else:
        review.show(files)
    return DONE
