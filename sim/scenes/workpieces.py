"""The large steel pieces that stand in the industrial bay."""

from __future__ import annotations

import numpy as np

from sim.scenes.scrap import CYLINDER, Body, Part, box


def stepped_plate(rng: np.random.Generator) -> Body:
    """A medium-thick plate: two plates welded on in steps, a bent-up end, a rib, two bosses."""
    a, b, c = rng.uniform(0.95, 1.1), rng.uniform(0.58, 0.68), rng.uniform(0.012, 0.016)
    a1, b1, c1 = rng.uniform(0.45, 0.55), rng.uniform(0.36, 0.44), rng.uniform(0.006, 0.010)
    a2, b2, c2 = rng.uniform(0.2, 0.26), rng.uniform(0.16, 0.22), rng.uniform(0.008, 0.012)
    x1, y1 = rng.uniform(-0.25, -0.1), rng.uniform(-0.1, 0.1)
    top, step = 2.0 * c, 2.0 * (c + c1)
    bend, wing = np.radians(rng.uniform(3.0, 5.0)), rng.uniform(0.14, 0.2)
    wing_at = (a + np.cos(bend) * wing, 0.0, c + np.sin(bend) * wing)
    parts = (
        box((a, b, c), (0.0, 0.0, c)),
        box((a1, b1, c1), (x1, y1, top + c1)),
        box((a2, b2, c2), (x1 - 0.12, y1 + 0.08, step + c2)),
        box((wing, b, c), wing_at, tilt=-bend),
        box((0.012, 0.8 * b, 0.015), (a - 0.22, 0.0, top + 0.015)),
        Part(CYLINDER, (0.075, 0.012), (0.55 * a, -0.6 * b, top + 0.012)),
        Part(CYLINDER, (0.075, 0.012), (0.55 * a, 0.6 * b, top + 0.012)),
    )
    return Body(parts, (a, b, c))
