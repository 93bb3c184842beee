"""Quaternions against MuJoCo's own functions, from 1e-12 rad to pi."""

from math import pi

import mujoco
import numpy as np
import pytest
import torch
from helpers import random_quats

from torchrl_nerd.geometry.rotations import (
    orientation_error,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_normalize,
    rotate,
    rotate_inverse,
    wrap_angle,
)

ROWS = 300


def rotation_vectors(rows, generator):
    """Random directions, lengths log-uniform from 1e-12 rad to just under pi."""
    axis = torch.randn(rows, 3, dtype=torch.float64, generator=generator)
    axis = axis / torch.linalg.vector_norm(axis, dim=-1, keepdim=True)
    exponent = torch.rand(rows, 1, dtype=torch.float64, generator=generator)
    return axis * 1e-12 * (0.999 * pi * 1e12) ** exponent


def by_mujoco(function, width, *rows):
    """What a ``mju_`` function writes for each row."""
    out = np.empty((len(rows[0]), width))
    for result, *inputs in zip(out, *(x.numpy() for x in rows), strict=True):
        function(result, *inputs)
    return torch.from_numpy(out)


def assert_close(got, want, tolerance=1e-14):
    torch.testing.assert_close(got, want, rtol=tolerance, atol=tolerance)


def test_products_and_turns_are_mujocos(generator):
    a, b = random_quats(ROWS, generator), random_quats(ROWS, generator)
    v = torch.randn(ROWS, 3, dtype=torch.float64, generator=generator)
    assert_close(quat_multiply(a, b), by_mujoco(mujoco.mju_mulQuat, 4, a, b))
    assert_close(quat_conjugate(a), by_mujoco(mujoco.mju_negQuat, 4, a))
    turned = by_mujoco(lambda r, q, x: mujoco.mju_rotVecQuat(r, x, q), 3, a, v)
    assert_close(rotate(a, v), turned)
    assert_close(rotate_inverse(a, rotate(a, v)), v)
    assert_close(rotate(quat_multiply(a, b), v), rotate(a, rotate(b, v)))


def test_exponential_is_mujocos_at_every_angle(generator):
    vector = rotation_vectors(ROWS, generator)

    def by_axis(result, v):
        angle = np.linalg.norm(v)
        mujoco.mju_axisAngle2Quat(result, v / angle, angle)

    got, want = quat_exp(vector), by_mujoco(by_axis, 4, vector)
    assert_close(got, want)
    # the imaginary part keeps its relative precision, however small the angle
    torch.testing.assert_close(got[:, 1:], want[:, 1:], rtol=1e-13, atol=0.0)


def test_logarithm_inverts_the_exponential_at_every_angle(generator):
    vector = rotation_vectors(ROWS, generator)
    torch.testing.assert_close(quat_log(quat_exp(vector)), vector, rtol=1e-12, atol=0.0)
    quat = random_quats(ROWS, generator)
    sign = torch.where(quat[:, :1] < 0.0, -1.0, 1.0)
    assert_close(quat_exp(quat_log(quat)), sign * quat)


def test_logarithm_is_mujocos_and_ignores_the_sign(generator):
    quat = random_quats(ROWS, generator)
    velocity = by_mujoco(lambda r, q: mujoco.mju_quat2Vel(r, q, 1.0), 3, quat)
    assert_close(quat_log(quat), velocity, 1e-12)
    assert torch.equal(quat_log(-quat), quat_log(quat))
    assert torch.linalg.vector_norm(quat_log(quat), dim=-1).max() <= pi + 1e-12


def test_half_turns_are_their_own_inverse(generator):
    axis = random_quats(ROWS, generator)[:, 1:]
    axis = axis / torch.linalg.vector_norm(axis, dim=-1, keepdim=True)
    half_turn = torch.cat((torch.zeros(ROWS, 1), axis), -1)
    v = torch.randn(ROWS, 3, dtype=torch.float64, generator=generator)
    for quat in (half_turn, -half_turn):
        assert_close(rotate(quat_exp(quat_log(quat)), v), rotate(quat, v), 1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-4, 1e-3, 1.0, 3.0])
def test_gradients_are_right_and_finite(angle, generator):
    axis = random_quats(1, generator)[0, 1:]
    vector = (angle * axis / torch.linalg.vector_norm(axis)).requires_grad_()
    assert torch.autograd.gradcheck(quat_exp, vector)
    assert torch.autograd.gradcheck(lambda v: quat_log(quat_exp(v)), vector)


def test_angle_between_rotations(generator):
    quat, seen_from = random_quats(ROWS, generator), random_quats(ROWS, generator)
    vector = rotation_vectors(ROWS, generator)
    turned = quat_multiply(quat, quat_exp(vector))
    angle = torch.linalg.vector_norm(vector, dim=-1)
    assert_close(orientation_error(quat, turned), angle, 1e-13)
    assert_close(orientation_error(-turned, quat), angle, 1e-13)
    moved = quat_multiply(seen_from, quat), quat_multiply(seen_from, turned)
    assert_close(orientation_error(*moved), angle, 1e-13)


def test_normalisation_keeps_the_rotation(generator):
    quat = random_quats(ROWS, generator)
    scale = 10.0 ** (6.0 * torch.rand(ROWS, 1, generator=generator) - 3.0)
    assert_close(quat_normalize(scale * quat), quat)
    zero = quat_normalize(torch.zeros(2, 4, dtype=torch.float64))
    assert zero.tolist() == [[1.0, 0.0, 0.0, 0.0]] * 2


def test_what_is_no_number_is_no_rotation():
    odd = torch.tensor([[torch.nan] * 4, [0.0] * 4])
    found = quat_normalize(odd)
    assert found[0].isnan().all() and found[1].tolist() == [1.0, 0.0, 0.0, 0.0]


def test_wrapped_angles_are_the_same_angles(generator):
    angle = 200.0 * torch.rand(ROWS, dtype=torch.float64, generator=generator) - 100.0
    wrapped = wrap_angle(angle)
    assert_close(wrapped.sin(), angle.sin(), 1e-13)
    assert_close(wrapped.cos(), angle.cos(), 1e-13)
    assert (wrapped >= -pi).all() and (wrapped < pi).all()


def test_wrapping_holds_at_the_last_bit_of_its_borders():
    border = pi * torch.tensor([-3.0, -1.0, 0.0, 1.0, 3.0], dtype=torch.float64)
    infinity = torch.full_like(border, torch.inf)
    for angle in (border, border.nextafter(-infinity), border.nextafter(infinity)):
        wrapped = wrap_angle(angle)
        assert_close(wrapped.cos(), angle.cos(), 1e-13)
        assert (wrapped >= -pi).all() and (wrapped < pi).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_precision_and_leading_dimensions_are_kept(dtype, generator):
    quat = random_quats(6, generator).to(dtype).reshape(2, 3, 1, 4)
    v = torch.randn(5, 3, dtype=dtype, generator=generator)
    turned = rotate(quat, v)
    assert turned.shape == (2, 3, 5, 3) and turned.dtype == dtype
    assert quat_log(quat).dtype == quat_exp(v).dtype == dtype
    assert_close(turned[1, 2, 4], rotate(quat[1, 2, 0], v[4]), 1e-6)


def test_one_rotation_meets_many(generator):
    one, many = random_quats(1, generator)[0], random_quats(6, generator)
    for first, second in ((one, many), (many, one)):
        want = quat_multiply(first.expand(6, 4), second.expand(6, 4))
        assert torch.equal(quat_multiply(first, second), want)
        want = orientation_error(first.expand(6, 4), second.expand(6, 4))
        assert torch.equal(orientation_error(first, second), want)
