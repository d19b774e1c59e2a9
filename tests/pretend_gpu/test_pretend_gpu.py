"""The pretend GPU itself: it notes each thing that it is to find, where it happens, and nothing else."""

from __future__ import annotations

import pytest
from pretend_gpu.run import Report, run_on_pretend_gpu

CLEAN = {
    "arithmetic": "(x * 2 + 1).sin().sum()",
    "python numbers": "x.clamp(0.1, 0.9).add_(1).pow_(2)",
    "numbers of the CPU": "torch.where(x > torch.tensor(0.5), x, torch.tensor(0.0)) + torch.tensor(2.0)",
    "views": "x[1:, None].expand(-1, 3).reshape(-1).view(2, -1).t()",
    "new tensors": "torch.zeros(3, device=CUDA), torch.arange(4, device=x.device), x.new_ones(2), torch.rand(3, device=CUDA)",
    "indices of the GPU": "x[i] + x.index_select(0, i) + x.gather(0, i)",
    "filling a mask": "x.clone()[x > 0.5] = 0.0",
    "masked_fill": "x.masked_fill(x > 0.5, 0.0)",
    "in place": "x.clone().mul_(x).copy_(x)",
    "products": "torch.einsum('ij,jk->ik', m, m) @ m + torch.baddbmm(m[None], m[None], m[None])",
    "repeats of known length": "x[:3].repeat_interleave(i, output_size=6)",
    "inverse": "torch.linalg.inv_ex(m + 3 * torch.eye(3, device=CUDA))",
    "backward": "w.grad = None; (w * x).exp().sum().backward()",
    "to its own device": "x.to(CUDA), x.to('cuda'), x.to(torch.float64)",
    "pinned memory": "torch.ones(5).pin_memory().to(CUDA, non_blocking=True)",
    "back to pinned memory": "torch.empty(5, pin_memory=True).copy_(x, non_blocking=True)",
    "nothing to copy": "torch.ones(0).to(CUDA), x[:0].cpu()",
    "the CPU alone": "torch.ones(3).nonzero(), torch.ones(3).sum().item(), torch.ones(3)[torch.ones(3) > 0]",
    "stacks": "torch.cat([x, x]), torch.stack([x, x])",
    "recording an event": "torch.cuda.Event().record()",
    "search with a capacity": "search(32)",
}
MIXING = {
    "add": "x + torch.ones(5)",
    "in place on the CPU": "torch.ones(5).add_(x)",
    "number of the CPU changed": "torch.tensor(1.0).add_(x[0])",
    "where": "torch.where(torch.ones(5) > 0, x, x)",
    "cat": "torch.cat([x, torch.ones(5)])",
    "stack of numbers": "torch.stack([x[0], torch.tensor(1.0)])",
    "matmul": "m @ torch.ones(3, 3)",
    "index_select": "x.index_select(0, torch.arange(3))",
    "gather": "x.gather(0, torch.arange(3))",
    "index_add": "x.index_add(0, i, torch.ones(3))",
    "indices of the GPU for the CPU": "torch.ones(5)[i]",
    "values of the CPU": "x.clone()[i] = torch.ones(3)",
    "generator of the CPU": "torch.rand(3, device=CUDA, generator=torch.Generator())",
    "network on the CPU": "torch.nn.Linear(5, 2)(x)",
    "loss": "torch.nn.functional.mse_loss(x, torch.ones(5))",
}
WAITS = {
    "item": "x.sum().item()",
    "bool": "bool((x > 0).all())",
    "int": "int(i[0])",
    "float": "float(x[0])",
    "format": "f'{x[0]:.3f}'",
    "index of a list": "[1, 2, 3][i[0]]",
    "tolist": "x.tolist()",
    "cpu": "x.cpu()",
    "numpy": "x.cpu().numpy()",
    "new tensor like it on the CPU": "x.to('cpu', torch.float64)",
    "copy to the CPU": "torch.ones(5).copy_(x)",
    "copy to the CPU without pinned memory": "torch.ones(5).copy_(x, non_blocking=True)",
    "pinned memory and waiting": "torch.ones(5).pin_memory().to(CUDA)",
    "nonzero": "(x > 0.5).nonzero()",
    "where of one": "torch.where(x > 0.5)",
    "mask": "x[x > 0.5]",
    "putting at a mask": "x.clone()[x > 2] = x[:0]",
    "filling a mask with a value of the GPU": "x.clone()[x > 0.5] = x[0]",
    "masked_select": "x.masked_select(x > 0.5)",
    "unique": "i.unique()",
    "unique_consecutive": "i.unique_consecutive()",
    "repeats": "x[:3].repeat_interleave(i)",
    "bincount": "i.bincount()",
    "equal": "torch.equal(x, x)",
    "allclose": "torch.allclose(x, x)",
    "inv": "torch.linalg.inv(m + 3 * torch.eye(3, device=CUDA))",
    "solve": "torch.linalg.solve(m + 3 * torch.eye(3, device=CUDA), m)",
    "cholesky": "torch.linalg.cholesky(torch.eye(3, device=CUDA))",
    "eigh": "torch.linalg.eigh(m + m.t())",
    "synchronize": "torch.cuda.synchronize()",
    "synchronizing an event": "torch.cuda.Event().synchronize()",
    "synchronizing a stream": "torch.cuda.current_stream().synchronize()",
    "backward": "Waits.apply(w * 2).sum().backward()",
    "backward of an index": "w.grad = None; w.relu()[w.detach() > 2].sum().backward()",
    "in a thread": "run_in_thread(lambda: x.sum().item())",
    "search without a capacity": "search(None)",
}
COPIES = {
    "tensor": "torch.tensor([1.0, 2.0], device=CUDA)",
    "new_tensor": "x.new_tensor([1, 2])",
    "number": "torch.tensor(1.0, device=CUDA)",
    "as_tensor": "torch.as_tensor(np.ones(3), dtype=torch.float32, device=CUDA)",
    "to": "torch.ones(3).to(CUDA)",
    "cuda": "torch.ones(3).cuda()",
    "to without waiting": "torch.ones(3).to(CUDA, non_blocking=True)",
    "copy": "x.clone().copy_(torch.ones(5))",
    "setting a part": "x.clone()[1:] = torch.ones(4)",
    "indices of the CPU": "x[torch.tensor([0, 1])]",
    "list of indices": "x[[0, 1]]",
    "putting a number at indices": "x.clone()[i] = 1.0",
    "module": "torch.nn.Linear(2, 2, bias=False).to(CUDA)",
    "in a thread": "run_in_thread(lambda: torch.tensor([1.0], device=CUDA))",
    "backward": "Copies.apply(w * 2).sum().backward()",
}
KERNELS = {
    "arithmetic": (4, "(x * 2 + 1).sin().sum()"),
    "nothing": (0, "x[1:].view(2, 2).t(), torch.empty(3, device=CUDA), x[:0] + 1"),
    "backward": (4, "torch.autograd.grad((w * x).sum(), w)"),
    "search": (11, "search(32)"),
    "search and gradient": (11 + 3 + 2, "search(32, points)[0].sum().backward()"),
    "operator of ours without a kernel for GPUs": (1, "torch.ops.snarf.blend(weights, still[:, :2], None, 'auto')"),
}
GROUPS = {"clean": CLEAN, "mixing": MIXING, "waits": WAITS, "copies": COPIES}
CODE = """
import sys, threading
import numpy as np
import torch
from pretend_gpu.device import CUDA, watch
from snarfcli.deformer.ops import complete_search

class Waits(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return x.clone()

    @staticmethod
    def backward(ctx, gradient):
        return gradient * gradient.sum().item()

class Copies(Waits):
    @staticmethod
    def backward(ctx, gradient):
        return gradient * torch.tensor([2.0], device=CUDA)

def run_in_thread(function):
    thread = threading.Thread(target=function)
    thread.start()
    thread.join()

box = [torch.tensor(corner, device=CUDA) for corner in ([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0])]
still = torch.eye(3, 4).reshape(12).expand(1, 8, 12).contiguous().to(CUDA)
points = torch.zeros(1, 5, 3, device=CUDA, requires_grad=True)
def search(capacity, points=points.detach()):
    return complete_search(points, still, *box, [2, 2, 2], None, 1e-5, 10, True, capacity, "auto")

weights = torch.ones(2, 2, 2, 2, device=CUDA)
x, m, i = torch.rand(5, device=CUDA), torch.rand(3, 3, device=CUDA), torch.tensor([1, 2, 3], device=CUDA)
w = torch.rand(5, device=CUDA, requires_grad=True)
"""


@pytest.fixture(scope="module")
def report() -> Report:
    """Run all of the snippets in one process, each with a watch of its own."""
    snippets = [(f"{group}: {name}", code) for group, of_group in GROUPS.items() for name, code in of_group.items()]
    snippets += [(f"kernels: {name}", code) for name, (_, code) in KERNELS.items()]
    parts = [f"with watch({name!r}):\n    {code}\n" for name, code in snippets]
    return run_on_pretend_gpu(CODE + "".join(parts))


def events(report: Report, group: str, name: str) -> dict[str, int]:
    """Return the numbers of events of a snippet, without the kinds that did not happen."""
    seen = report[f"{group}: {name}"]
    return {kind: len(getattr(seen, kind)) for kind in ("mixing", "waits", "copies") if getattr(seen, kind)}


@pytest.mark.parametrize("name", CLEAN)
def test_what_a_gpu_does_alone_is_not_noted(report, name):
    assert events(report, "clean", name) == {}


@pytest.mark.parametrize(
    ("group", "name"), [(group, name) for group in ("mixing", "waits", "copies") for name in GROUPS[group]]
)
def test_each_kind_of_event_is_noted_and_no_other(report, group, name):
    assert set(events(report, group, name)) == {group}


@pytest.mark.parametrize("name", KERNELS)
def test_kernels_are_counted(report, name):
    assert report[f"kernels: {name}"].kernels == KERNELS[name][0]


def test_events_name_the_line_of_the_package_also_in_the_backward_pass():
    code = """
        import torch
        from pretend_gpu.device import CUDA, watch
        from snarfcli.deformer.grid import CanonicalGrid
        from snarfcli.deformer.roots import invert_3x3

        matrices = torch.eye(3, device=CUDA).expand(4, 3, 3).clone().requires_grad_()
        with watch("package") as seen:
            CanonicalGrid(-torch.ones(3, device=CUDA), torch.ones(3, device=CUDA))
            invert_3x3(matrices)[1].sum().backward()
        with watch("program"):
            matrices.sum().item()
    """
    report = run_on_pretend_gpu(code)
    assert report["package"].waits[0].split(": ")[1].startswith("snarfcli/deformer/grid.py:")
    assert any("backward of MulBackward0 < snarfcli/deformer/roots.py:" in launch for launch in report["package"].launches)
    assert report["program"].waits == ["_local_scalar_dense float32[]: program.py:12 <module>"]


def test_mixing_is_an_error_where_nobody_watches():
    code = "import torch\nfrom pretend_gpu.device import CUDA\ntorch.ones(2, device=CUDA) + torch.ones(2)\n"
    with pytest.raises(AssertionError, match=r"Expected all tensors to be on the same device: aten\.add"):
        run_on_pretend_gpu(code)


def test_the_device_computes_what_the_cpu_does():
    code = """
        import copy
        import torch
        from pretend_gpu.device import CUDA

        torch.manual_seed(0)
        network = torch.nn.Sequential(torch.nn.Linear(3, 8), torch.nn.Softplus(), torch.nn.Linear(8, 1))
        x = torch.rand(10, 3)

        def gradients(network, x):
            network(x).square().sum().backward()
            optimizer = torch.optim.Adam(network.parameters(), lr=0.1)
            optimizer.step()
            return [value.detach().cpu() for p in network.parameters() for value in (p.grad, p)]

        other = copy.deepcopy(copy.deepcopy(network).to(CUDA))
        assert all(parameter.is_cuda and isinstance(parameter, torch.nn.Parameter) for parameter in other.parameters())
        for one, two in zip(gradients(network, x), gradients(other, x.to(CUDA)), strict=True):
            assert torch.equal(one, two)
        print("equal")
    """
    assert run_on_pretend_gpu(code).output == "equal\n"


def test_a_replay_of_a_graph_computes_from_the_present_values():
    code = """
        import torch
        from pretend_gpu.device import CUDA, watch

        x, total, step = (torch.zeros(size, device=CUDA) for size in (3, 3, 1))
        w = torch.ones(3, device=CUDA, requires_grad=True)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            step.add_(1)
            y = (x * w).square().view(3, 1).sum(1)  # a view and its result
            (gradient,) = torch.autograd.grad(y.sum(), w)
            total[1:] += y[1:]
        assert (step.item(), total.tolist()) == (0, [0, 0, 0])
        assert y.isnan().all()
        for first in (1.0, 2.0):
            x.copy_(torch.tensor([first, 2, 3]))
            with watch(f"replay {first:.0f}"):
                graph.replay()
            assert y.tolist() == [first**2, 4, 9]
            assert gradient.tolist() == [2 * first**2, 8, 18]
        assert (step.item(), total.tolist()) == (2, [0, 8, 18])
    """
    report = run_on_pretend_gpu(code)
    for seen in report.seen:
        assert (seen.mixing, seen.waits, seen.copies) == ([], [], [])
        assert seen.kernels > 5


def test_waits_and_copies_are_errors_in_a_capture():
    code = """
        import torch
        from pretend_gpu.device import CUDA

        x = torch.ones(2, device=CUDA)
        for what in (lambda: x.sum().item(), lambda: torch.tensor([1.0], device=CUDA), torch.cuda.synchronize):
            try:
                with torch.cuda.graph(torch.cuda.CUDAGraph()):
                    what()
            except RuntimeError as error:
                print(error)
    """
    lines = run_on_pretend_gpu(code).output.splitlines()
    assert len(lines) == 3
    assert all("operation not permitted when stream is capturing" in line and ": program.py:" in line for line in lines)


def test_emulated_kernels_find_what_those_for_the_cpu_find_and_can_be_captured():
    code = """
        import torch
        from pretend_gpu.device import CUDA, watch
        from snarfcli.deformer.implicit import add_implicit_gradient, implicit_backward
        from snarfcli.deformer.ops import complete_search

        torch.manual_seed(0)
        points, box = torch.rand(2, 20, 3) - 0.5, [-torch.ones(3), torch.ones(3)]
        transforms = torch.eye(3, 4).reshape(12) + 0.05 * torch.rand(2, 27, 12)
        settings = [3, 3, 3], None, 1e-5, 10, True
        wanted = complete_search(points, transforms, *box, *settings, None, "auto")
        given = [tensor.to(CUDA) for tensor in (points, transforms, *box)]
        with watch("without a capacity"):
            complete_search(*given, *settings, None, "auto")
        with watch("reference"):
            found = complete_search(*given, *settings, None, "reference")
            assert len(found[0]) == len(wanted[0])
        with watch("with a capacity"):
            found = complete_search(*given, *settings, 64, "auto")
        roots = found[3].item()
        assert roots == len(wanted[0])
        for one, other in zip(found[:3], wanted[:3], strict=True):
            assert torch.allclose(one[:roots].cpu(), other, atol=1e-5)

        rest = (*given[2:], [3, 3, 3], 2, 20)
        gradient, total = torch.rand(64, 3, device=CUDA), torch.zeros(2, 27, 12, device=CUDA)
        of_points, of_transforms = implicit_backward(gradient, *found[:3], *rest, True, True, "auto")
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            added = add_implicit_gradient(total, gradient, *found[:3], *rest, True, "auto")  # without an operator
        with watch("replay"):
            graph.replay()
            graph.replay()
        assert torch.allclose(added.cpu(), of_points.cpu()) and torch.allclose(total.cpu(), 2 * of_transforms.cpu())
    """
    report = run_on_pretend_gpu(code, emulated=True)
    (wait,) = report["without a capacity"].waits
    assert wait.startswith("copy int32[2] to the CPU: snarfcli/native/cuda_launches.py:")
    assert report["reference"].mixing == []
    assert report["reference"].kernels > 100  # operators of PyTorch
    for name in ("with a capacity", "replay"):
        assert (report[name].mixing, report[name].waits, report[name].copies) == ([], [], [])
    assert any(line.startswith("search_cells: snarfcli/") for line in report["with a capacity"].launches)
    assert [count for line, count in report["replay"].launches.items() if line.startswith("implicit_backward: ")] == [2]
