"""The axioms of rigid motions, with angles from nothing to pi, and scipy as a judge."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from depthba import se3

Array = NDArray[np.float64]

quick = settings(deadline=None, max_examples=60)
coordinate = st.floats(-100, 100, allow_subnormal=False)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)
axis = vector.filter(lambda v: np.linalg.norm(v) > 1e-3).map(lambda v: v / np.linalg.norm(v))
angle = st.one_of(
    st.floats(0, np.pi),
    st.floats(-16, -2).map(lambda e: 10**e),
    st.floats(-16, -2).map(lambda e: np.pi - 10**e),
    st.sampled_from([0.0, np.pi / 2, np.pi, 0.01, 0.1]),
)


@st.composite
def rotation_vectors(draw: st.DrawFn) -> Array:
    return np.asarray(draw(angle) * draw(axis))


@st.composite
def poses(draw: st.DrawFn) -> Array:
    return se3.make(se3.exp_so3(draw(rotation_vectors())), draw(vector))


@quick
@given(rotation_vectors())
def test_exp_is_a_rotation_and_agrees_with_scipy(phi: Array) -> None:
    R = se3.exp_so3(phi)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(R) > 0
    np.testing.assert_allclose(R, Rotation.from_rotvec(phi).as_matrix(), atol=1e-14)


@quick
@given(rotation_vectors())
def test_log_undoes_exp_up_to_the_two_ways_round_at_pi(phi: Array) -> None:
    back = se3.log_so3(se3.exp_so3(phi))
    theta = float(np.linalg.norm(phi))
    assert np.linalg.norm(back) <= np.pi + 1e-12
    if np.pi - theta < 1e-7 and back @ phi < 0:
        back = back + 2 * np.pi * phi / theta
    # relative: a rotation by 1e-12 rad comes back with its digits
    error = float(np.abs(back - phi).max())
    assert error <= (1e-13 * max(1.0, theta) if theta > 1e-3 else 1e-12 * theta)


@quick
@given(rotation_vectors())
def test_exp_undoes_log(phi: Array) -> None:
    R = Rotation.from_rotvec(phi).as_matrix()
    np.testing.assert_allclose(se3.exp_so3(se3.log_so3(R)), R, atol=1e-14)


@quick
@given(poses(), poses())
def test_difference_is_what_retract_needs(T_a: Array, T_b: Array) -> None:
    delta = se3.difference(T_a, T_b)
    np.testing.assert_allclose(se3.retract(T_b, delta), T_a, atol=1e-12)
    np.testing.assert_allclose(se3.difference(T_a, T_a), 0, atol=1e-12)


@quick
@given(poses(), poses(), poses())
def test_inverse_and_composition(T_a: Array, T_b: Array, T_c: Array) -> None:
    np.testing.assert_allclose(se3.inverse(T_a) @ T_a, np.eye(4), atol=1e-11)
    np.testing.assert_allclose(
        se3.inverse(T_a @ T_b), se3.inverse(T_b) @ se3.inverse(T_a), atol=1e-10
    )
    est = np.stack([T_a, T_b])
    aligned = se3.align_first(est, np.stack([T_c, T_a]))
    np.testing.assert_allclose(aligned[0], T_c, atol=1e-10)
    np.testing.assert_allclose(
        se3.inverse(aligned[0]) @ aligned[1], se3.inverse(T_a) @ T_b, atol=1e-9
    )


@quick
@given(poses())
def test_quaternions_round_trip_with_w_first_quadrant(T: Array) -> None:
    q = se3.quaternion(T)
    assert q[3] >= 0
    np.testing.assert_allclose(np.linalg.norm(q), 1, atol=1e-15)
    np.testing.assert_allclose(se3.from_quaternion(T[:3, 3], q), T, atol=1e-14)
    np.testing.assert_allclose(se3.from_quaternion(T[:3, 3], -3 * q), T, atol=1e-14)


def test_quaternion_order_is_x_y_z_w() -> None:
    quarter_turn = se3.make(se3.exp_so3([0, 0, np.pi / 2]), [1, 2, 3])
    np.testing.assert_allclose(se3.quaternion(quarter_turn), [0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    np.testing.assert_allclose(quarter_turn @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-15)


def test_perturbation_is_left_in_world_axes_about_the_origin_of_the_pose() -> None:
    T = se3.make(se3.exp_so3([0.3, -0.7, 2.0]), [4, 5, 6])
    step = 1e-6
    for k in range(6):
        delta = np.zeros(6)
        delta[k] = step
        slope = (se3.retract(T, delta) - se3.retract(T, -delta)) / (2 * step)
        expected = np.zeros((4, 4))
        if k < 3:
            expected[k, 3] = 1
        else:
            expected[:3, :3] = np.cross(np.eye(3)[k - 3], T[:3, :3].T).T
        np.testing.assert_allclose(slope, expected, atol=1e-9)


def test_batches_are_the_same_as_one_by_one() -> None:
    rng = np.random.default_rng(1)
    phi = rng.normal(size=(4, 5, 3)) * np.array([1e-9, 1e-3, 1.0, 2.0])[:, None, None]
    T = se3.make(se3.exp_so3(phi), rng.normal(size=(4, 5, 3)))
    delta = rng.normal(size=(4, 5, 6))
    for i in np.ndindex(4, 5):
        np.testing.assert_array_equal(se3.exp_so3(phi)[i], se3.exp_so3(phi[i]))
        np.testing.assert_allclose(se3.log_so3(T[..., :3, :3])[i], se3.log_so3(T[i][:3, :3]))
        np.testing.assert_allclose(se3.retract(T, delta)[i], se3.retract(T[i], delta[i]))
        np.testing.assert_allclose(se3.inverse(T)[i], se3.inverse(T[i]))


def test_rigid_tells_rotations_from_what_is_none() -> None:
    T = se3.make(se3.exp_so3([1, 2, 3]), [1, 2, 3])
    assert se3.is_rigid(T)
    mirrored, scaled, skewed, broken = T.copy(), T.copy(), T.copy(), T.copy()
    mirrored[:3, 0] *= -1
    scaled[:3, :3] *= 1.001
    skewed[3, 0] = 0.1
    broken[0, 3] = np.nan
    assert not any(se3.is_rigid(bad) for bad in (mirrored, scaled, skewed, broken, T[:3]))
