"""Random numbers of a training step: from a generator of PyTorch, or computed on a device from seed and step."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor

from snarfcli.native import cuda_draws
from snarfcli.native.backend import choose_backend

__all__ = ["Draws", "GeneratorDraws", "HashedDraws", "random_bits"]

_BITS = 2**32
_MIXED = 0x7FEB352D  # multiplier of the hash; below 2^31, so that its product with 32 bits fits an int64
_OF_SEED, _OF_PURPOSE = 0x9E3779B1, 0x85EBCA77  # odd numbers that keep the keys of seeds and purposes apart


class Draws(ABC):
    """A sequence of random tensors; each call continues it."""

    @abstractmethod
    def uniform(self, *size: int) -> Tensor:
        """Return numbers from 0 to below 1, float32."""

    @abstractmethod
    def normal(self, *size: int) -> Tensor:
        """Return normally distributed numbers, float32."""

    @abstractmethod
    def integers(self, below: int | Tensor, *size: int) -> Tensor:
        """Return whole numbers from 0 to below `below`, int64; a tensor of limits is broadcast against `size`."""


class GeneratorDraws(Draws):
    """The numbers of a generator on the CPU, copied to a device.

    Args:
        generator: source of the numbers.
        device: of the results.
    """

    def __init__(self, generator: torch.Generator, device: torch.device | str = "cpu") -> None:
        self._generator, self._device = generator, torch.device(device)

    @classmethod
    def seeded(cls, seed: int, device: torch.device | str = "cpu") -> GeneratorDraws:
        """Return the numbers of a new generator."""
        return cls(torch.Generator().manual_seed(seed), device)

    def uniform(self, *size: int) -> Tensor:
        return torch.rand(size, generator=self._generator).to(self._device)

    def normal(self, *size: int) -> Tensor:
        return torch.randn(size, generator=self._generator).to(self._device)

    def integers(self, below: int | Tensor, *size: int) -> Tensor:
        """As in `Draws`; reads a tensor of one limit, which waits for a GPU.

        Raises:
            ValueError: several limits.
        """
        if isinstance(below, Tensor):
            if below.numel() != 1:
                raise ValueError(f"below: wanted one limit, got {below.numel()}")
            below = int(below)
        return torch.randint(below, size, generator=self._generator).to(self._device)


class HashedDraws(Draws):
    """Numbers that depend on seed, step, purpose and place only, so that a step has them in every run.

    Nothing waits for a GPU, and nothing is copied to it: a step that is captured in a CUDA graph draws new numbers in every
    replay in which `step` has another value.

    Args:
        seed: of the run.
        step: [], int64, on the device of the results, from 0 to below 2^32.
        purpose: a small number; different ones give independent numbers.
    """

    def __init__(self, seed: int, step: Tensor, purpose: int) -> None:
        self._step = step
        self._key = _mixed((seed * _OF_SEED + purpose * _OF_PURPOSE + (seed >> 32)) % _BITS)
        self._calls = 0

    def uniform(self, *size: int) -> Tensor:
        return self._uniform(math.prod(size)).reshape(size)

    def normal(self, *size: int) -> Tensor:
        first, second = self._uniform(2 * math.prod(size)).reshape(2, *size).unbind(0)
        return (-2 * torch.log1p(-first)).sqrt() * (2 * torch.pi * second).cos()  # Box and Muller, 1958

    def integers(self, below: int | Tensor, *size: int) -> Tensor:
        return (self.bits(math.prod(size)).reshape(size) * below) >> 32

    def bits(self, count: int) -> Tensor:
        """Return `count` numbers of 32 random bits, [count], int64."""
        self._calls += 1
        return random_bits(self._step, _mixed(self._key + self._calls), count)

    def _uniform(self, count: int) -> Tensor:
        return (self.bits(count) >> 8).float() * 2.0**-24  # as many bits as a float32 holds, so that 1 is not reached


def _mixed(bits: int) -> int:
    """Return a hash of a number, 32 bits."""
    bits %= _BITS
    for _ in range(2):
        bits = (bits ^ bits >> 16) * _MIXED % _BITS
        bits = (bits ^ bits >> 15) * _MIXED % _BITS
    return bits ^ bits >> 16


@torch.library.custom_op("snarf::random_bits", mutates_args=())
def random_bits(step: Tensor, key: int, count: int) -> Tensor:
    """Return 32 random bits for each place of a step, [count], int64, from 0 to below 2^32.

    Args:
        step: [], int64.
        key: 32 bits, different for numbers that should be independent.
        count: number of places, at most 2^32.

    Source: the form of the hash (shift, xor, multiply) is that of the finalizer of MurmurHash3 (Appleby, 2011).
    """
    return _random_bits_reference(step, key, count)


@random_bits.register_kernel("cuda")
def _(step, key, count):
    if choose_backend("auto", step.device) == "native":
        return cuda_draws.random_bits(step, key, count)
    return _random_bits_reference(step, key, count)


@random_bits.register_fake
def _(step, key, count):
    return step.new_empty(count)


def _random_bits_reference(step: Tensor, key: int, count: int) -> Tensor:
    first = _mixed_tensor(step.reshape(1) ^ key)
    second = _mixed_tensor((step.reshape(1) + _mixed(key)) & (_BITS - 1))  # streams with the same first still differ
    places = _mixed_tensor(torch.arange(count, device=step.device) ^ first)
    return _mixed_tensor((places + second) & (_BITS - 1))


def _mixed_tensor(bits: Tensor) -> Tensor:
    """As `_mixed`, for each of several numbers."""
    for _ in range(2):
        bits = ((bits ^ (bits >> 16)) * _MIXED) & (_BITS - 1)
        bits = ((bits ^ (bits >> 15)) * _MIXED) & (_BITS - 1)
    return bits ^ (bits >> 16)
