"""How often patches count, from one settling to the next."""

from __future__ import annotations

import pytest

from depthba.optimiser.ending import ALIKE, EMPHASIS, Course


@pytest.mark.parametrize(
    ("alike", "counts"),
    [
        # less alike each time: as often as may be, and no more
        ([12.0, 4.0, 3.0, 2.9, 2.8], [1, 4, 16, 64, 64]),
        # four times had left them no less alike: as before, for good
        ([12.0, 4.0, 4.1, 3.0, 2.0], [1, 4, 1, 1, 1]),
        ([12.0, 4.0, 3.0, 3.1, 2.0], [1, 4, 16, 4, 4]),
        # once is not less than once
        ([12.0, 12.5, 11.0], [1, 1, 4]),
        ([ALIKE, 12.0], [1, 1]),
    ],
)
def test_patches_count_more_for_as_long_as_it_helps(alike: list[float], counts: list[int]) -> None:
    course, found = Course(), []
    for overall in alike:
        before = EMPHASIS[course.emphasis], course.emphasis
        changed = course.recount(overall)
        assert changed == ((EMPHASIS[course.emphasis], course.emphasis) != before)
        found.append(EMPHASIS[course.emphasis])
    assert found == counts
