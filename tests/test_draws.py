"""Random numbers of training steps: those of a generator, and those computed on a device."""

from __future__ import annotations

import pytest
import torch

from snarfcli.draws import GeneratorDraws, HashedDraws, _mixed, _mixed_tensor, random_bits


def hashed(seed=0, step=0, purpose=1):
    return HashedDraws(seed, torch.tensor(step), purpose)


def test_numbers_of_a_generator_are_those_of_pytorch():
    draws, generator = GeneratorDraws.seeded(3), torch.Generator().manual_seed(3)
    assert torch.equal(draws.integers(7, 5), torch.randint(7, (5,), generator=generator))
    assert torch.equal(draws.uniform(2, 3), torch.rand(2, 3, generator=generator))
    assert torch.equal(draws.normal(4), torch.randn(4, generator=generator))
    assert torch.equal(draws.integers(torch.tensor(7), 5), torch.randint(7, (5,), generator=generator))
    with pytest.raises(ValueError, match="below: wanted one limit, got 2"):
        draws.integers(torch.tensor([7, 8]), 2)


def test_hashed_numbers_depend_on_seed_step_purpose_and_call_only():
    assert torch.equal(hashed(4, 5, 6).uniform(100), hashed(4, 5, 6).uniform(100))
    assert torch.equal(hashed(4, 5, 6).uniform(100)[:10], hashed(4, 5, 6).uniform(10))  # by place, not by count
    draws = hashed(4, 5, 6)
    different = [draws.uniform(100), draws.uniform(100)]
    different += [hashed(*names).uniform(100) for names in ((5, 5, 6), (4, 6, 6), (4, 5, 7), (4 + 2**32, 5, 6))]
    for index, one in enumerate(different):
        for other in different[:index]:
            assert abs(float(torch.corrcoef(torch.stack([one, other]))[0, 1])) < 0.4
            assert not (one == other).all()


def test_hashed_numbers_are_spread_evenly():
    """Chi-squared over cells of single numbers, of neighbours in place, and of the same place in neighbouring steps."""
    values = torch.stack([hashed(1, step).uniform(1000) for step in range(100)])
    assert 0 <= values.min() < 1e-3
    assert 0.999 < values.max() < 1
    pairs = [values.reshape(1, -1).expand(2, -1), torch.stack([values[:, :-1], values[:, 1:]]).flatten(1)]
    pairs.append(torch.stack([values[:-1], values[1:]]).flatten(1))
    for first, second in (pairs[1], pairs[2]):
        counts = torch.bincount((first * 10).long() * 10 + (second * 10).long(), minlength=100).double()
        wanted = len(first) / 100
        assert float(((counts - wanted) ** 2 / wanted).sum()) < 160  # 99 degrees of freedom: 1 in 10,000 is above
    normal = hashed(2).normal(100_000)
    assert abs(float(normal.mean())) < 0.02
    assert abs(float(normal.std()) - 1) < 0.02
    assert normal.isfinite().all()


def test_hashed_integers_keep_their_limits():
    numbers = hashed().integers(7, 10_000)
    assert numbers.dtype == torch.int64
    assert torch.bincount(numbers).min() > 1300
    assert len(torch.bincount(numbers)) == 7
    limits = torch.tensor([[3], [5]])
    both = hashed().integers(limits, 2, 4000)
    assert both.amax(1).tolist() == [2, 4]
    assert torch.equal(hashed().integers(torch.tensor(7), 10_000), numbers)
    assert hashed().integers(7, 0).shape == (0,)


def test_the_hash_is_the_same_for_numbers_and_tensors():
    numbers = [0, 1, 2**31, 2**32 - 1, 123456789]
    assert _mixed_tensor(torch.tensor(numbers)).tolist() == [_mixed(number) for number in numbers]


def test_bits_as_an_operator():
    torch.library.opcheck(random_bits, (torch.tensor(3), 5, 11))
