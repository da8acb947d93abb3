"""`depthba review [RUN...]`: what happened in there?"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from eval import review


@dataclass(frozen=True)
class Arguments:
    """Open the recordings of runs in the Rerun viewer."""

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
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
        print("depthba review: --web and --screenshot exclude each other", file=sys.stderr)
        return 2
    files = review.recordings(arguments.runs)
    if arguments.json:
        shot = arguments.screenshot
        told = {"recordings": [str(f) for f in files], "screenshot": str(shot) if shot else None}
        print(json.dumps(told), flush=True)
    if arguments.screenshot is not None:
        review.screenshot(files, arguments.screenshot)
        if not arguments.json:
            print(arguments.screenshot)
    elif arguments.web:
        review.serve(files, arguments.port)
    else:
        review.show(files)
    return 0
