"""Kernels that an optimiser step launches on a GPU, counted without one, for each preset.

    python benchmarks/bm_optimizer.py          needs the samples of `snarf preprocess subject=50002`

"reference": `AveragedAdam.step` as it runs outside the CPU library; it waits for the sum of the gradients. "operators" and
"kernels": `AveragedAdam.step_on_device` by PyTorch's operators and by csrc/cuda/optimizer.cu. Each operator counts as one
kernel, except those that make views or uninitialised tensors.
"""

from __future__ import annotations

from collections.abc import Callable
from ctypes import Structure
from pathlib import Path
from unittest import mock

import torch
from common import arguments, print_machine, print_table, require
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from torch.utils._python_dispatch import TorchDispatchMode

from snarfcli.commands.train import TrainConfig, new_trainer
from snarfcli.hydra_config.schema import config_folder, register_schemas
from snarfcli.native.cuda_optimizer import run_adam_step
from snarfcli.samples.store import SampleStore
from snarfcli.training import optimizer as optimizer_module
from snarfcli.training.adam import adam_step_on_device_reference
from snarfcli.training.optimizer import AveragedAdam

_NO_KERNEL = {"empty", "empty_like", "empty_strided", "new_empty", "_local_scalar_dense", "unbind", "split"}


class Counter(TorchDispatchMode):
    """Counts the operators that compute something, and the numbers that are read back."""

    def __init__(self) -> None:
        super().__init__()
        self.kernels = self.waits = 0

    def __torch_dispatch__(self, function, types, arguments=(), keywords=None):
        name = function._schema.name.removeprefix("aten::")
        is_view = any(returned.alias_info and not returned.alias_info.is_write for returned in function._schema.returns)
        self.kernels += not is_view and name not in _NO_KERNEL
        self.waits += name == "_local_scalar_dense"
        return function(*arguments, **(keywords or {}))


class CountingLauncher:
    """Counts launches, and runs none."""

    def __init__(self) -> None:
        self.kernels = 0

    def threads(self, most: int) -> int:
        return most

    def launch(self, source: str, kernel: str, blocks: tuple[int, int], threads: int, arguments: Structure) -> None:
        self.kernels += 1


def count_kernels(optimizer: AveragedAdam) -> dict[str, tuple[int, int]]:
    """Return the kernels and the waits of one step, whose gradients are there: by name of the implementation."""
    numbers = (torch.tensor(1e-3), torch.tensor(0), torch.tensor(False))
    launcher = CountingLauncher()

    def count(step: Callable[[], object]) -> tuple[int, int]:
        with Counter() as counter:
            step()
        return counter.kernels + launcher.kernels, counter.waits

    def on_device(run: Callable) -> tuple[int, int]:
        with mock.patch.object(optimizer_module, "adam_step_on_device", run):
            return count(lambda: optimizer.step_on_device(*numbers))

    with mock.patch.object(optimizer_module, "choose_backend", return_value="reference"):
        reference = count(lambda: optimizer.step(1e-3, 0))
    operators = on_device(adam_step_on_device_reference)
    kernels = on_device(lambda *given: run_adam_step(launcher, *given))
    return {"reference": reference, "operators": operators, "kernels": kernels}


def main() -> None:
    options = arguments("Kernels of an optimiser step.", data_root={"default": "data", "help": "folder with the samples"})
    require(Path(options.data_root) / "processed/builtin/50002/manifest.json", "snarf preprocess subject=50002")
    register_schemas("train", TrainConfig)
    store = SampleStore.open(options.data_root, "builtin", "50002")
    print_machine()
    rows = []
    for name in ("quick", "standard", "paper"):
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            config: TrainConfig = OmegaConf.to_object(compose("train", [f"training={name}"]))
        trainer = new_trainer(config, store, torch.device("cpu"))
        trainer.advance()  # leaves gradients
        parameters = trainer.optimizer.parameters
        counts = count_kernels(trainer.optimizer)
        numbers = sum(parameter.numel() for parameter in parameters) / 1e6
        row = [name, str(len(parameters)), f"{numbers:.2f} million"]
        rows.append(row + [f"{kernels} and {waits} waits" for kernels, waits in counts.values()])
    print_table(["training", "parameters", "numbers", *counts], rows)


if __name__ == "__main__":
    main()
