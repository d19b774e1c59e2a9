"""The stages of gpu_check.py on the pretend GPU: what a CPU cannot show, such as captures, and mixing of devices."""

from __future__ import annotations

import json

from pretend_gpu.run import run_on_pretend_gpu
from toy_pack import toy_pack

STAGES = ("search", "gradient", "field")
CODE = """
    import sys
    from pathlib import Path

    import released_kernels
    import torch
    from gpu_checks import small_run
    from gpu_checks.context import Context
    from gpu_checks.report import Section
    from gpu_checks.stage_list import stage_function
    from pretend_gpu.device import CUDA, watch

    released_kernels._launcher_for = lambda tensor: released_kernels._Emulated(tensor.dtype)
    torch.cuda.Event.elapsed_time = lambda first, last: 1.0

    pack, folder = Path(sys.argv[1]), Path(sys.argv[2])
    for stage in sys.argv[3:]:
        context = Context(CUDA, True, pack, folder, Section(folder / f"{stage}.json"), 100.0)
        with watch(stage):
            stage_function(stage)(context)
    sys.argv[1:] = ["--device", "cuda", "--pack", str(pack), "--queries", "20"]
    with watch("small run"):
        small_run.main()
"""


def test_stages_run_on_a_gpu_and_all_their_captures_succeed(tmp_path):
    pack = toy_pack(tmp_path)
    report = run_on_pretend_gpu(CODE, pack, tmp_path, *STAGES)
    for name in (*STAGES, "small run"):
        assert report[name].mixing == [], name
    for stage in STAGES:
        text = (tmp_path / f"{stage}.json").read_text()
        assert "failed" not in text
        assert all(goal["value"] is not None for goal in json.loads(text)["goals"].values())
    assert "roots" in report.output
