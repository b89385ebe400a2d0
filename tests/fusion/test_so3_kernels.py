"""The compiled rotations against scipy and `poet_loc.core.geometry`, from nothing to half a turn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusion import so3_kernels as kernels
from poet_loc.core import geometry

compiling = settings(deadline=None)  # the first call compiles
component = st.floats(-1.0, 1.0, allow_nan=False)
angle = st.one_of(
    st.floats(0.0, 1e-3),
    st.sampled_from([0.0, 1e-12, 1e-8, 0.99e-4, 1e-4, 1.01e-4, 1e-3]),
    st.floats(1e-3, np.pi - 1e-3),
)


@st.composite
def rotation_vectors(draw, angles=angle):
    direction = np.array([draw(component) for _ in range(3)])
    norm = np.linalg.norm(direction)
    direction = direction / norm if norm > 1e-3 else np.array([0.0, 0.0, 1.0])
    return draw(angles) * direction


def exp(v):
    out = np.zeros(9)
    kernels.exp_so3(*v, out)
    return out


def log(m):
    out = np.zeros(3)
    kernels.log_so3(m, out)
    return out


@compiling
@given(rotation_vectors())
def test_exp_is_scipys(v):
    np.testing.assert_allclose(exp(v).reshape(3, 3), Rotation.from_rotvec(v).as_matrix(), atol=5e-15)


@compiling
@given(rotation_vectors())
def test_log_inverts_exp(v):
    np.testing.assert_allclose(log(exp(v)), v, atol=1e-9)  # near half a turn a matrix says no more
    if np.linalg.norm(v) < 3.0:
        np.testing.assert_allclose(log(exp(v)), v, rtol=1e-12, atol=1e-15)


@compiling
@given(rotation_vectors(st.floats(np.pi - 1e-6, np.pi)))
def test_log_at_half_a_turn_is_one_of_its_two_names(v):
    found = log(exp(v))
    np.testing.assert_allclose(np.linalg.norm(found), np.linalg.norm(v), atol=1e-8)
    np.testing.assert_allclose(exp(found), exp(v), atol=1e-8)


@compiling
@given(rotation_vectors(), st.sampled_from([1.0, -1.0]))
def test_jacobians_are_those_of_the_geometry(v, sign):
    found, inverse = np.zeros(9), np.zeros(9)
    kernels.left_jacobian(*v, sign, found)
    kernels.left_jacobian_inverse(*v, sign, inverse)
    J = geometry.so3_left_jacobian(sign * v)
    np.testing.assert_allclose(found.reshape(3, 3), J, atol=1e-8)  # 1 - cos cancels at small angles
    np.testing.assert_allclose(inverse.reshape(3, 3), geometry.so3_left_jacobian_inverse(sign * v), atol=1e-7)
    np.testing.assert_allclose(found.reshape(3, 3) @ inverse.reshape(3, 3), np.eye(3), atol=1e-7)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_products_are_numpys(seed):
    rng = np.random.default_rng(seed)
    a, b, v = rng.standard_normal((3, 3)), rng.standard_normal((3, 3)), rng.standard_normal(3)
    for kernel, expected in (
        (kernels.multiply, a @ b),
        (kernels.multiply_transposed_left, a.T @ b),
        (kernels.multiply_transposed_right, a @ b.T),
    ):
        out = np.zeros(9)
        kernel(a.ravel(), b.ravel(), out)
        np.testing.assert_allclose(out.reshape(3, 3), expected, atol=1e-14)
    out = np.zeros(3)
    kernels.apply(a.ravel(), *v, out)
    np.testing.assert_allclose(out, a @ v, atol=1e-14)
    kernels.apply_transposed(a.ravel(), *v, out)
    np.testing.assert_allclose(out, a.T @ v, atol=1e-14)
    out = np.zeros(9)
    kernels.times_skew(a.ravel(), *v, out)
    np.testing.assert_allclose(out.reshape(3, 3), a @ geometry.skew(v), atol=1e-14)


@pytest.mark.parametrize("disturbance", [1e-16, 1e-9, 1e-5])
def test_orthonormalise_pulls_back_onto_rotations(disturbance):
    rng = np.random.default_rng(0)
    for _ in range(20):
        R = Rotation.random(rng=rng).as_matrix()
        m = (R + disturbance * rng.standard_normal((3, 3))).ravel()
        kernels.orthonormalise(m, np.zeros(9))
        found = m.reshape(3, 3)
        np.testing.assert_allclose(found.T @ found, np.eye(3), atol=max(1e-15, 20 * disturbance**2))
        np.testing.assert_allclose(found, R, atol=max(1e-15, 10 * disturbance))
