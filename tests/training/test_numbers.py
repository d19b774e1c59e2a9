"""Reported numbers that stay on the device until they are read."""

from __future__ import annotations

import pytest
import torch

from snarfcli.training.numbers import History, StepNumbers


def numbers(**values: float) -> StepNumbers:
    return StepNumbers.of({name: torch.tensor(value) for name, value in values.items()})


def test_numbers_of_a_step_are_a_mapping():
    loss = torch.tensor(2.0, requires_grad=True)
    step = StepNumbers.of({"loss": loss * 2, "count": torch.tensor(3)})
    assert dict(step) == {"loss": 4.0, "count": 3.0}
    assert list(step) == ["loss", "count"]
    with pytest.raises(KeyError):
        step["other"]


def test_history_keeps_the_last_steps_and_drops_those_that_are_taken_again():
    history = History(3)
    for step in range(1, 6):
        history.add(step, numbers(loss=step))
    assert [step for step, _ in history.since(0)] == [3, 4, 5]
    assert history.means() == {"loss": 4.0}
    history.add(4, numbers(loss=7.0, other=1.0))  # steps 4 and 5 were none
    assert [(step, dict(one)) for step, one in history.since(4)] == [(4, {"loss": 7.0, "other": 1.0})]
    assert history.means() == {"loss": 5.0, "other": 1.0}
    assert History(3).means() == {}
