"""Two calibrations made one, hand_eye.json, and the camera poses by the arm."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from depthba import se3
from depthba.dataset import Dataset
from depthba.errors import OptionError
from rig.hand_eye.apply import apply
from rig.hand_eye.combine import combine, combined_record
from rig.hand_eye.record import FILE, HandEyeRecord, Open, head, read_record, write_content
from tests.rig.arm_scene import X, write_arm

Floats = NDArray[np.float64]


def record(T: Floats, covariance: Floats, **changes: Any) -> HandEyeRecord:
    plain = HandEyeRecord(
        "board", "eye-in-hand", "converged", True, "the motions fix it", T, covariance
    )
    return replace(plain, **changes)


def drawn(rng: np.random.Generator) -> tuple[Floats, Floats]:
    """A covariance of some tenths of a millimetre and hundredths of a degree, and a pose."""
    root = rng.standard_normal((6, 6)) * np.repeat([2e-4, 4e-4], 3)[:, None]
    return root @ root.T, se3.retract(X, root @ rng.standard_normal(6))


def test_the_combination_is_the_best_of_both_and_knows_how_good_it_is() -> None:
    rng = np.random.default_rng(0)
    squares, better = [], 0
    for _ in range(200):
        (C_a, T_a), (C_b, T_b) = drawn(rng), drawn(rng)
        found = combine(record(T_a, C_a), record(T_b, C_b, method="from-depth"))
        swapped = combine(record(T_b, C_b), record(T_a, C_a))
        np.testing.assert_allclose(found.T, swapped.T, atol=1e-10)
        delta = se3.difference(found.T, X)
        squares.append(delta @ np.linalg.solve(found.covariance, delta))
        own = [np.trace(C) for C in (C_a, C_b)]
        better += np.trace(found.covariance) < min(own)
    assert better == 200
    low, high = chi2.ppf([0.001, 0.999], 6 * 200)
    assert low < sum(squares) < high


def test_an_open_direction_is_taken_from_the_other() -> None:
    small = np.diag(np.repeat([1e-4, 1e-4], 3) ** 2)
    wide = small.copy()
    wide[2, 2] = 0.01**2
    off = se3.retract(X, [0.0, 0.0, 0.2, 0.0, 0.0, 0.0])
    direction = Open("z", np.array([0, 0, 0.01, 0, 0, 0]), 1.0)
    weak = record(off, wide, verdict="weak", trusted=False, open=(direction,), method="from-depth")
    found = combine(weak, record(X, small))
    np.testing.assert_allclose(found.T, X, atol=1e-6)
    together = combined_record(weak, record(X, small), found)
    assert together.trusted and together.method == "from-depth+board"
    assert combined_record(weak, weak, combine(weak, weak)).verdict == "weak"


def test_two_that_disagree_are_refused_and_so_is_what_is_not_trusted() -> None:
    small = np.diag(np.repeat([1e-4, 1e-4], 3) ** 2)
    one = record(X, small)
    far = record(se3.retract(X, [0.002, 0, 0, 0, 0, 0]), small, method="from-depth")
    with pytest.raises(OptionError, match=r"disagree by 2\.00 mm and 0\.000 degrees, 5\.8 times"):
        combine(one, far)
    for other, text in (
        (record(X, small, mount="eye-to-hand"), "of one kind"),
        (record(X, small, verdict="far", trusted=False), "is far, expected one to be trusted"),
        (replace(one, T=None, covariance=None), "has no transform"),
    ):
        with pytest.raises(OptionError, match=text):
            combine(one, other)


def test_hand_eye_json_is_read_as_it_was_written(tmp_path: Path) -> None:
    dataset = write_arm(tmp_path / "arm", frames=3)
    rng = np.random.default_rng(1)
    covariance, T = drawn(rng)
    direction = Open("z", np.arange(6.0), 0.5)
    for one in (
        record(T, covariance, open=(direction,)),
        record(T, covariance, mount="eye-to-hand"),
        HandEyeRecord("board", "eye-in-hand", "inconsistent", False, "wrong", None, None),
    ):
        write_content(head(one, dataset), tmp_path)
        back = read_record(tmp_path / FILE, "--from")
        for name in ("method", "mount", "verdict", "trusted", "reason"):
            assert getattr(back, name) == getattr(one, name)
        for found, given in ((back.T, one.T), (back.covariance, one.covariance)):
            if given is None:
                assert found is None
            else:
                np.testing.assert_array_equal(found, given)
        assert [o.name for o in back.open] == [o.name for o in one.open]
    raw = json.loads((tmp_path / FILE).read_text())
    for damage in ({"format": "x"}, {"covariance": [[1]]}, {"method": None, "open": 3}):
        (tmp_path / FILE).write_text(json.dumps(raw | damage | {"T_flange_camera": X.tolist()}))
        with pytest.raises(OptionError, match="--from"):
            read_record(tmp_path / FILE, "--from")
    (tmp_path / FILE).write_text("{")
    with pytest.raises(OptionError, match="expected JSON"):
        read_record(tmp_path / FILE, "--from")


def test_poses_by_the_arm(tmp_path: Path) -> None:
    dataset = write_arm(tmp_path / "arm", frames=4)
    covariance = 1e-8 * np.eye(6)
    flange = np.stack([f.T_base_flange for f in dataset if f.T_base_flange is not None])
    written = apply(dataset, record(X, covariance))
    assert written.world == "world"
    # in this dataset the base is the world
    again = Dataset.open(dataset.path)
    np.testing.assert_allclose(again.poses("arm"), flange @ X, atol=1e-9)
    bare = replace(dataset, T_flange_camera=None)
    assert apply(bare, record(X, covariance)).world == "base"
    fixed = apply(dataset, record(X, covariance, mount="eye-to-hand"))
    assert fixed.world == "flange"
    np.testing.assert_allclose(fixed.T_world_camera, se3.inverse(flange) @ X, atol=1e-12)
    with pytest.raises(OptionError, match="is weak, expected one to be trusted"):
        apply(dataset, record(X, covariance, verdict="weak", trusted=False))
