from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from depthba import se3
from depthba.errors import OptionError, OutOfReach
from depthba.kinematics import UR16E
from depthba.straight import JUMP, SPACING, flange, straight
from depthba.ur_calibration import read_calibration

READY = np.array([-1.927, -1.584, 1.424, -1.41, -1.571, -0.356])
CALIBRATED = UR16E.calibrated(a=1e-3, d=[2e-3, 0, -1e-3, 0, 0, 1e-4], alpha=2e-3, theta=-1e-3)


def test_the_compiled_flange_is_the_arms() -> None:
    for arm in (UR16E, CALIBRATED):
        for q in np.random.default_rng(0).uniform(-3.0, 3.0, (50, 6)):
            np.testing.assert_allclose(flange(arm.links(), q), arm.forward(q), atol=1e-14)


@pytest.mark.parametrize("arm", [UR16E, CALIBRATED])
def test_every_point_is_on_the_line_and_near_the_one_before(arm) -> None:
    rng = np.random.default_rng(1)
    T = arm.forward(READY)
    for _ in range(20):
        delta = rng.uniform(-1.0, 1.0, 6) * np.repeat([0.12, 0.4], 3)
        T_goal = se3.retract(T, delta)
        line = straight(arm, READY, T_goal)
        assert line.length == pytest.approx(np.linalg.norm(delta[:3]))
        assert line.angle == pytest.approx(np.linalg.norm(delta[3:]))
        share = np.linspace(0.0, 1.0, len(line.joints))[:, None]
        T_line = se3.retract(T, share * delta)
        np.testing.assert_allclose(arm.forward(line.joints), T_line, atol=1e-10)
        steps = np.abs(np.diff(line.joints, axis=0)).max()
        assert steps <= JUMP
        assert line.length / (len(line.joints) - 1) <= SPACING[0] + 1e-12


def test_the_line_ends_where_the_arm_does_and_says_why() -> None:
    T = UR16E.forward(READY)
    with pytest.raises(OutOfReach, match=r"1\.5 m .* no joints reach it"):
        straight(UR16E, READY, se3.retract(T, [1.5, 0, 0, 0, 0, 0]))
    near = READY.copy()
    near[5] = 2.0 * np.pi - 0.1
    turned = UR16E.forward(np.add(near, [0, 0, 0, 0, 0, 0.5]))
    with pytest.raises(OutOfReach, match="limit"):
        straight(UR16E, near, turned)
    # Through the axis of the base, where the shoulder would have to turn at once.
    through = se3.make(T[:3, :3], [-T[0, 3], -T[1, 3], T[2, 3]])
    with pytest.raises(OutOfReach, match=r"singularity|no joints"):
        straight(UR16E, READY, through)


CONF = """[mount]
delta_theta = [ 1e-05, 2e-05, 3e-05, 0, 0, 0 ]
delta_a = [ 3.1e-05, 0.001, -2e-4, 0, 0, 0 ]
delta_d = [ 1e-4, 150.2, -150.1, 0, 0, 0 ]
delta_alpha = [ 0, 1e-3, 0, 0, 0, 0 ]
joint_checksum = [ 0x1 ]
"""


def test_a_calibration_is_added_to_the_published_arm(tmp_path: Path) -> None:
    conf, text = tmp_path / "calibration.conf", tmp_path / "calibration.yaml"
    conf.write_text(CONF)
    text.write_text("\n".join(line.replace(" = ", ": ") for line in CONF.splitlines()[1:5]) + "\n")
    expected = UR16E.calibrated(
        a=[3.1e-5, 0.001, -2e-4, 0, 0, 0],
        d=[1e-4, 150.2, -150.1, 0, 0, 0],
        alpha=[0, 1e-3, 0, 0, 0, 0],
        theta=[1e-5, 2e-5, 3e-5, 0, 0, 0],
    )
    assert read_calibration(conf) == expected == read_calibration(text)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("delta_a", "delta_b"), "no delta_a"),
        (("3e-05, 0, 0, 0 ]", "3e-05 ]"), "delta_theta .* expected 6 numbers"),
        (("150.2", "much"), "delta_d .* expected 6 numbers"),
        (("[mount]\n", ""), "calibration.conf"),
        (("0, 1e-3", ".nan, 1e-3"), "delta_alpha"),
    ],
)
def test_a_bad_calibration_is_named(tmp_path: Path, change: tuple[str, str], says: str) -> None:
    path = tmp_path / "calibration.conf"
    path.write_text(CONF.replace(*change))
    with pytest.raises(OptionError, match=says) as error:
        read_calibration(path)
    assert "\n" not in str(error.value)
