"""What a GPU would do with every model, in training, evaluation, extraction and export: never mix devices."""

from __future__ import annotations

from pathlib import Path

import pytest
from pretend_gpu.run import Report, run_on_pretend_gpu
from toy_training import toy_store

from snarfcli.models.trained_field import SYSTEMS

KINDS = (*SYSTEMS, "voxel", "grids", "local", "broyden", "preset", "refined")
"""The systems, and kinds of fields, searches and training of fast_snarf (`every_model`)."""
PARTS = (
    "start", "bootstrap step", "usual step", "step with upkeep", "validation", "checkpoint", "finish", "evaluation",
    "metrics of surfaces and weights", "mesh of a pose on the CPU",
    "mesh of a pose on the GPU", "animation of the field surface", "viewer",
)  # fmt: skip
CODE = """
    import sys
    from pathlib import Path
    from pretend_gpu.every_model import run
    from snarfcli.samples.store import SampleStore

    root, folder, *kinds = sys.argv[1:]
    store = SampleStore.open(root, "builtin", "toy")
    for kind in kinds:
        (Path(folder) / kind).mkdir()
        run(kind, store, Path(folder) / kind)
"""


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> tuple[Report, Path]:
    """Run all kinds in one process; return what was seen, and the folder with a folder of files for each."""
    root, folder = tmp_path_factory.mktemp("data"), tmp_path_factory.mktemp("files")
    toy_store(root, points=400, frames=12)
    return run_on_pretend_gpu(CODE, root, folder, *KINDS), folder


@pytest.mark.parametrize("kind", KINDS)
def test_no_part_of_a_model_mixes_devices(done, kind):
    report, folder = done
    parts = {seen.name.removeprefix(f"{kind}: "): seen for seen in report.seen if seen.name.startswith(f"{kind}: ")}
    for seen in parts.values():
        print(*seen.lines(), sep="\n")  # what waits and what is copied, for those who look
    assert [what for seen in parts.values() for what in seen.mixing] == []
    is_skinned = "skinned mesh" in parts
    assert set(PARTS) <= set(parts)
    assert all(parts[name].kernels > 0 for name in (*PARTS, *(("skinned mesh", "export") if is_skinned else ())))
    assert ("step with refined poses" in parts) == (kind == "refined")
    files = {file.name for file in (folder / kind).iterdir()}
    assert (
        files == {"frame_000000.ply"} | ({f"{kind}.glb"} if is_skinned else set()) or kind == "pose_onet"
    )  # has no surface yet
