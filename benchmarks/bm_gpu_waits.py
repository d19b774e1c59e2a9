"""How often the host waits for a GPU and copies to it, and how many kernels start, counted without a GPU.

    python benchmarks/bm_gpu_waits.py            needs the samples of `snarf preprocess subject=50002`
    python benchmarks/bm_gpu_waits.py --lines 1  also what waits, copies and starts most kernels

A pretend GPU (tests/pretend_gpu) computes on the CPU and notes what a GPU would do; the kernels of PyTorch's operators are
estimates, those of ours are counted. The avatar is untrained: it has the shape from which training starts.
"""

from __future__ import annotations

import sys
from pathlib import Path

from common import arguments, print_machine, print_table, require

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "native"))

from pretend_gpu.build import why_no_pretend_gpu
from pretend_gpu.run import run_on_pretend_gpu

_MOST_LINES = 8
CODE = """
    import sys, tempfile
    from pathlib import Path
    import torch
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf
    from pretend_gpu.device import CUDA, watch
    from snarfcli.commands.train import TrainConfig, new_trainer
    from snarfcli.evaluation.evaluate import measure_frame
    from snarfcli.hydra_config.schema import config_folder, register_schemas
    from snarfcli.motions import builtin_motion
    from snarfcli.samples.store import SampleStore

    register_schemas("train", TrainConfig)
    store = SampleStore.open(sys.argv[1], "builtin", "50002")
    for name in ("paper", "quick"):
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            config = OmegaConf.to_object(compose("train", [f"training={name}"]))
        torch.manual_seed(0)
        trainer = new_trainer(config, store, CUDA)
        for _ in range(2):  # these count the roots; later steps have fixed shapes
            trainer.advance()
        settings, after = config.training, config.training.bootstrap_steps + 1
        steps = {"step of the bootstrap": 1, "usual step": after}
        if settings.agreement_weight:
            steps["step with made-up poses"] = after - after % settings.agreement_every + settings.agreement_every
        for what, step in steps.items():
            trainer.step = step
            with watch(f"{name}: {what}"):
                trainer.advance()
        avatar = trainer.averaged_avatar()
        avatar.model.eval()
        sequence, pose = store.sequences("test")[0], torch.zeros(store.skeleton.num_joints, 3)
        measure_frame(avatar, sequence, 0)
        with watch(f"{name}: frame of an evaluation"):
            measure_frame(avatar, sequence, 0)
        given = torch.rand(1, 20000, 3).to(CUDA), avatar.bone_transforms(pose[None]), pose[None].to(CUDA)
        with watch(f"{name}: query of 20,000 points"):
            avatar.query(*given)
    with watch(f"{name}: field mesh, 128 voxels"):
        avatar.mesh(pose, resolution=128)
    with watch(f"{name}: first skinned mesh"):
        avatar.mesh(pose, resolution=128, surface="skinned")
    with watch(f"{name}: next skinned mesh"):
        avatar.mesh(pose + 0.1, resolution=128, surface="skinned")
    with tempfile.TemporaryDirectory() as folder, watch(f"{name}: export of 10 frames"):
        motion = builtin_motion("lunges", 0, frame_rate=10).slice(stop=10)
        avatar.export_glb(Path(folder) / "avatar.glb", motion, triangles=2000, resolution=128)
"""


def main() -> None:
    options = arguments(
        "Waits for a GPU, copies to it, and kernels.",
        data_root={"default": "data", "help": "folder with the samples"},
        lines={"type": int, "default": 0, "help": "1 lists what waits, copies and starts most kernels"},
    )
    require(Path(options.data_root) / "processed/builtin/50002/manifest.json", "snarf preprocess subject=50002")
    if (reason := why_no_pretend_gpu()) is not None:
        sys.exit(reason)
    report = run_on_pretend_gpu(CODE, Path(options.data_root).absolute(), emulated=True, timeout_s=3600)
    print_machine()
    header = ["training", "work", "waits", "copies to the GPU", "kernels", "mixed devices"]
    counts = [(seen, len(seen.waits), len(seen.copies), seen.kernels, len(seen.mixing)) for seen in report.seen]
    print_table(header, [[*seen.name.split(": "), *map(str, numbers)] for seen, *numbers in counts])
    for seen in report.seen if options.lines else []:
        print("", *seen.lines(), sep="\n")
        print(*(f"  {count} kernels {line}" for line, count in seen.launches.most_common(_MOST_LINES)), sep="\n")


if __name__ == "__main__":
    main()
