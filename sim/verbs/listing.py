"""What `generate --list` shows: the scenes, rigs, sensors and stages of the noise there are."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from depthba.verbs.output import length
from sim.noise import choose_stages
from sim.rigs import RIGS, find_rig
from sim.scenes import SCENES
from sim.sensors import SENSORS


def describe() -> dict[str, list[dict[str, Any]]]:
    """All there is to choose from, as `--list --json` prints it: pixels and metres."""
    return {
        "scenes": [
            {
                "id": scene.id,
                "rig": scene.rig,
                "sensor": scene.sensor,
                "frames": find_rig(scene.rig).frames,
                "description": scene.description,
            }
            for scene in SCENES.values()
        ],
        "rigs": [
            {
                "name": name,
                "frames": find_rig(name).frames,
                "description": _about(find_rig(name)),
            }
            for name in RIGS
        ],
        "sensors": [
            {
                "name": name,
                "width": sensor.width,
                "height": sensor.height,
                "focal_length_px": sensor.camera.fx,
                "baseline_m": sensor.baseline,
                "depth_min_m": sensor.depth_min,
                "depth_max_m": sensor.depth_max,
                "noise": {
                    "sigma_m": sensor.noise.sigma_m,
                    "at_m": sensor.noise.at_m,
                    "power": sensor.noise.power,
                },
            }
            for name, sensor in SENSORS.items()
        ],
        "noise_stages": [
            {"name": stage.name, "noise": stage.is_noise, "description": _about(stage)}
            for stage in choose_stages()
        ],
    }


def show(there: dict[str, list[dict[str, Any]]]) -> None:
    """Print it as tables."""
    # A pipe has no width of its own, and a table must not be cut there.
    console = Console(width=None if sys.stdout.isatty() else 120, highlight=False)
    heads = ["scene", "rig", "sensor", ">frames", "what stands there"]
    console.print(_table(heads, [_words(scene) for scene in there["scenes"]]))
    console.print(_table(["rig", ">frames", "what it does"], [_words(r) for r in there["rigs"]]))
    heads = ["sensor", ">pixels", ">focal length", ">baseline", ">range", ">range noise"]
    console.print(_table(heads, [_sensor(sensor) for sensor in there["sensors"]]))
    rows = [
        [stage["name"], "left out" if stage["noise"] else "stays", stage["description"]]
        for stage in there["noise_stages"]
    ]
    console.print(_table(["stage of the noise", "--clean", "what it does"], rows))


def _words(row: dict[str, Any]) -> list[str]:
    return ["" if value is None else str(value) for value in row.values()]


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """A head that begins with > stands over numbers."""
    table = Table(box=SIMPLE_HEAD)
    for head in heads:
        last = head == heads[-1]
        table.add_column(
            head.lstrip(">"), justify="right" if head[:1] == ">" else "left", no_wrap=not last
        )
    for row in rows:
        table.add_row(*row)
    return table


def _sensor(sensor: dict[str, Any]) -> list[str]:
    noise = sensor["noise"]
    growth = {0.0: "", 1.0: ", as z", 2.0: ", as z²"}
    power = growth.get(noise["power"], f", as z^{noise['power']:g}")
    return [
        sensor["name"],
        f"{sensor['width']} x {sensor['height']}",
        f"{sensor['focal_length_px']:.0f} px",
        f"{sensor['baseline_m']:g} m",
        f"{sensor['depth_min_m']:g} to {sensor['depth_max_m']:g} m",
        f"{length(noise['sigma_m'])} at {noise['at_m']:g} m{power}",
    ]


def _about(thing: object) -> str:
    return (inspect.getdoc(type(thing)) or "").partition("\n")[0]
