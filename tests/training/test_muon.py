"""Muon: the update of PyTorch's, and what orthogonal directions have to be."""

import pytest
import torch

from torchrl_nerd.training.muon import Muon, orthogonalize

SHAPES = [(8, 8), (24, 8), (8, 24), (8, 8)]


def matrices(generator):
    found = [torch.randn(shape, generator=generator) for shape in SHAPES]
    return [matrix.requires_grad_() for matrix in found]


@pytest.mark.parametrize(("feature", "most"), [("avx512_bf16", 0.01), ("avx2", 0.03)])
def test_it_is_pytorchs_but_for_bfloat16(feature, most, generator, monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {feature: True})
    mine = matrices(generator)
    theirs = [weight.detach().clone().requires_grad_() for weight in mine]
    before = [weight.detach().clone() for weight in mine]
    how = {"weight_decay": 0.0, "adjust_lr_fn": "original"}
    both = Muon(mine, 0.1), torch.optim.Muon(theirs, 0.1, **how)
    for _ in range(3):
        for one, other in zip(mine, theirs, strict=True):
            one.grad = torch.randn(one.shape, generator=generator)
            other.grad = one.grad.clone()
        for optimizer in both:
            optimizer.step()
    for one, other, start in zip(mine, theirs, before, strict=True):
        apart, moved = (one - other).detach().norm(), (one - start).detach().norm()
        assert apart < most * moved


@pytest.mark.parametrize("shape", [(6, 6), (20, 6), (6, 20)])
def test_singular_values_are_about_one_and_turning_commutes(
    shape, generator, monkeypatch
):
    x = torch.randn(4, *shape, generator=generator)
    x *= torch.logspace(-3, 3, 4)[:, None, None]  # whatever their size
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx2": True})
    found = orthogonalize(x)
    assert torch.linalg.svdvals(found).sub(0.9).abs().max() < 0.5
    turn = torch.linalg.qr(torch.randn(shape[0], shape[0], generator=generator))[0]
    torch.testing.assert_close(orthogonalize(turn @ x), turn @ found, rtol=0, atol=1e-4)


def test_a_matrix_without_a_gradient_stays(generator):
    weights = matrices(generator)
    before = [weight.detach().clone() for weight in weights]
    weights[0].grad = torch.randn(SHAPES[0], generator=generator)
    optimizer = Muon(weights, 0.1)
    optimizer.step()
    moved = [not torch.equal(a, b) for a, b in zip(weights, before, strict=True)]
    assert moved == [True, False, False, False] and list(optimizer.state) == weights[:1]
