"""Muon: updates with singular values near one, the same as PyTorch's own but for bf16."""

from copy import deepcopy

import pytest
import torch

from torchrl_nerd.training.muon import COEFFICIENTS, ITERATIONS, Muon, orthogonalize

SHAPES = [(64, 64), (192, 64), (64, 256), (3, 17), (20, 2), (1, 8)]


def random_matrices(shape: tuple[int, ...], generator: torch.Generator) -> torch.Tensor:
    """Matrices whose singular values differ by a factor of ten at most."""
    noise = torch.randn(shape, generator=generator)
    u, s, v = torch.linalg.svd(noise, full_matrices=False)
    s = 0.1 + 0.9 * torch.rand(s.shape, generator=generator)
    size = 10.0 ** (8.0 * torch.rand((), generator=generator) - 4.0)
    return size * u * s[..., None, :] @ v


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_singular_values_become_one_and_vectors_stay(shape, batch, generator):
    matrices = random_matrices((*batch, *shape), generator)
    result = orthogonalize(matrices)
    assert result.shape == matrices.shape
    u, _, v = torch.linalg.svd(matrices, full_matrices=False)
    inside = u.mT @ result @ v.mT
    values = inside.diagonal(dim1=-2, dim2=-1)
    assert (values > 0.6).all() and (values < 1.25).all()
    outside = inside - torch.diag_embed(values)
    assert outside.abs().max() < 1e-2
    left = result - u @ inside @ v
    assert left.abs().max() < 1e-2


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("smallest", [1e-1, 1e-5])
def test_singular_values_go_through_the_quintic(shape, smallest, generator):
    u, s, v = torch.linalg.svd(
        torch.randn(shape, generator=generator).double(), full_matrices=False
    )
    s = smallest ** torch.rand(s.shape, generator=generator).double()
    scaled, (a, b, c) = s / s.square().sum().sqrt(), COEFFICIENTS
    for _ in range(ITERATIONS):
        scaled = a * scaled + b * scaled**3 + c * scaled**5
    result = orthogonalize((u * s @ v).float())
    torch.testing.assert_close(
        result, (u * scaled @ v).float(), rtol=0.0, atol=5e-3 * float(scaled.max())
    )
    with torch.autocast("cpu", torch.bfloat16):  # as in training
        assert torch.equal(orthogonalize((u * s @ v).float()), result)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_batch_is_its_matrices_and_a_transpose_stays_one(shape, generator):
    matrices = random_matrices((4, *shape), generator)
    together = orthogonalize(matrices)
    apart = torch.stack([orthogonalize(matrix) for matrix in matrices])
    torch.testing.assert_close(together, apart, rtol=1e-4, atol=1e-4)
    turned = orthogonalize(matrices.mT).mT
    torch.testing.assert_close(together, turned, rtol=1e-3, atol=1e-3)


def test_zero_stays_zero():
    assert torch.equal(orthogonalize(torch.zeros(2, 5, 3)), torch.zeros(2, 5, 3))


def train(optimizer, weights, gradients) -> list[list[torch.Tensor]]:
    """The change of every weight at every step."""
    changes = []
    for step_gradients in gradients:
        before = [weight.detach().clone() for weight in weights]
        for weight, gradient in zip(weights, step_gradients, strict=True):
            weight.grad = gradient.clone()
        optimizer.step()
        changes.append([w.detach() - b for w, b in zip(weights, before, strict=True)])
    return changes


def draw(generator, shapes=SHAPES[:3], steps=6):
    weights = [torch.randn(shape, generator=generator) for shape in shapes]
    gradients = [
        [random_matrices(shape, generator) for shape in shapes] for _ in range(steps)
    ]
    return weights, gradients


def test_updates_are_those_of_pytorch_but_for_rounding(generator):
    weights, gradients = draw(generator)
    own, reference = ([w.clone().requires_grad_() for w in weights] for _ in range(2))
    changes = train(Muon(own, lr=0.02), own, gradients)
    muon = torch.optim.Muon(reference, lr=0.02, weight_decay=0.0, momentum=0.95)
    for ours, theirs in zip(changes, train(muon, reference, gradients), strict=True):
        for a, b in zip(ours, theirs, strict=True):
            cosine = (a * b).sum() / (a.norm() * b.norm())
            assert cosine > 0.99
            assert 0.97 < a.norm() / b.norm() < 1.03


def test_the_state_goes_through_a_state_dict(generator):
    weights, gradients = draw(generator)
    first = [w.clone().requires_grad_() for w in weights]
    optimizer = Muon(first, lr=0.03, momentum=0.9)
    train(optimizer, first, gradients[:3])
    second = [w.detach().clone().requires_grad_() for w in first]
    resumed = Muon(second)
    resumed.load_state_dict(deepcopy(optimizer.state_dict()))
    train(optimizer, first, gradients[3:])
    train(resumed, second, gradients[3:])
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_a_weight_without_gradient_stays(generator):
    weights, gradients = draw(generator, [(4, 4), (4, 4)], 1)
    moved, kept = (w.clone().requires_grad_() for w in weights)
    moved.grad = gradients[0][0]
    Muon([moved, kept]).step()
    assert torch.equal(kept, weights[1]) and not torch.equal(moved, weights[0])
