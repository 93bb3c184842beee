"""Parts of a whole draw numbers of their own, whatever its seed."""

import torch

from torchrl_nerd.seeds import fold_in

SEEDS = 0, 1, 255, 256, 257, 512, 2**20, 2**31 - 1


def test_no_two_seeds_or_parts_draw_alike():
    drawn = [
        torch.rand(4, generator=fold_in(seed, part))
        for seed in SEEDS
        for part in (0, 1, 999)
    ]
    assert len(torch.stack(drawn).unique(dim=0)) == len(drawn)


def test_a_part_draws_the_same_again():
    one, other = (torch.rand(4, generator=fold_in(7, 3)) for _ in range(2))
    assert torch.equal(one, other)
