"""`snarf doctor`: the report, also on a machine with a broken installation."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from fake_gpus import FakeDriver, install_gpus

from snarfcli.cli import main as cli
from snarfcli.commands import doctor, doctor_tools
from snarfcli.commands.doctor import DoctorConfig
from snarfcli.native import cuda_compile, library


def report(caplog, data_root, output_root) -> dict[str, str]:
    """Run the command on two folders; return its lines by name."""
    caplog.set_level("INFO", logger="snarfcli")
    assert doctor.run(DoctorConfig(str(data_root), str(output_root))) == 0
    lines = [record.getMessage() for record in caplog.records]
    return {line[2:18].strip(): line[18:] for line in lines if line.startswith("  ")} | {"end": lines[-1]}


@pytest.fixture
def broken_library(monkeypatch):
    monkeypatch.setenv("SNARF_NATIVE_LIBRARY", "/nowhere/lib.so")
    library._load.cache_clear()
    yield
    monkeypatch.undo()
    library._load.cache_clear()


def test_everything_is_told(caplog, tmp_path):
    import torch

    lines = report(caplog, tmp_path / "data", tmp_path / "outputs")
    assert lines["torch"] == version("torch")  # torch.__version__ may have more, such as +cu124
    assert lines["threads"].startswith(f"{torch.get_num_threads()} ")
    assert lines["native library"].startswith(f"active, {library.instruction_set()}, {library.library_path()}")
    assert "no folder" in lines["data_root"]
    assert "snarf preprocess" in lines["samples"]
    assert "snarf train" in lines["avatars"]
    others = {"snarf", "python", "platform", "numpy", "model", "devices", "CUDA kernels", "ffmpeg", "embree", "libigl"}
    assert others <= set(lines)
    assert "licence GPL-3" in lines["pymeshlab"]


@pytest.mark.parametrize(
    ("package", "name", "told"),
    [
        ("embreex", "embree", "libigl traces the rays, several times slower; there are no wheels for Linux on ARM"),
        ("pymeshlab", "pymeshlab", "poisson=own) and libigl decimates; data=clothed needs it"),
        ("scipy", "scipy", "not installed"),
    ],
)
def test_what_stands_in_for_a_missing_package_is_named(caplog, tmp_path, monkeypatch, package, name, told):
    there = doctor_tools.installed_version
    monkeypatch.setattr(doctor_tools, "installed_version", lambda one: None if one == package else there(one))
    lines = report(caplog, tmp_path, tmp_path)
    assert lines[name].startswith("not installed")
    assert told in lines[name]
    assert lines[name].endswith(f'; run "pip install {package}"')
    assert name in lines["end"]


def test_the_extras_of_single_functions_are_told(caplog, tmp_path, monkeypatch):
    versions = {"viser": "1.2", "bpy": "5.0"}
    there = doctor_tools.installed_version
    packages = {package for package, _ in doctor_tools.EXTRAS.values()}
    monkeypatch.setattr(doctor_tools, "installed_version", lambda one: versions.get(one) if one in packages else there(one))
    lines = report(caplog, tmp_path, tmp_path)
    assert lines["view"] == "viser 1.2, for snarf view"
    assert lines["hub"].startswith("not installed; for avatars of the Hugging Face Hub")
    assert lines["hub"].endswith(": pip install 'snarf[hub]'")
    assert "hub" not in lines["end"]


def test_every_extra_for_users_is_told():
    """Those of the commands themselves, of the tests and of the documentation are no single functions."""
    tomllib = pytest.importorskip("tomllib")  # Python 3.11
    content = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))
    declared = content["project"]["optional-dependencies"]
    users = {name for name in declared if not name.startswith(("commands", "test", "docs"))}
    assert users == set(doctor_tools.EXTRAS)
    for name, (package, _) in doctor_tools.EXTRAS.items():
        assert any(requirement.startswith(f"{package}>=") for requirement in declared[name])


def test_data_and_avatars_are_found(caplog, tmp_path):
    for file in ("data/dfaust/x", "data/processed/builtin/50002/manifest.json", "outputs/builtin/50002/demo/avatar.pt"):
        (tmp_path / file).parent.mkdir(parents=True)
        (tmp_path / file).touch()
    lines = report(caplog, tmp_path / "data", tmp_path / "outputs")
    assert lines["data_root"].endswith("folders: dfaust")
    assert lines["samples"] == "builtin/50002"
    assert lines["avatars"] == "builtin/50002/demo"


def test_a_fallback_is_named_with_its_reason(caplog, tmp_path, broken_library):
    lines = report(caplog, tmp_path, tmp_path)
    assert lines["native library"].startswith("not available, the reference in PyTorch is used: SNARF_NATIVE_LIBRARY names")
    assert "native library" in lines["end"]


def test_a_driver_that_is_too_old_is_named(caplog, tmp_path, monkeypatch):
    install_gpus(monkeypatch, [], FakeDriver(12020))
    lines = report(caplog, tmp_path, tmp_path)
    assert lines["driver"] == "for CUDA 12.2 and older"
    assert lines["devices"].startswith("none, since the NVIDIA driver supports CUDA 12.2, and this PyTorch needs 13.0;")
    assert lines["devices"].endswith("everything runs on the CPU")
    assert "devices" in lines["end"]


def test_kernels_that_cannot_be_compiled_are_not_available(caplog, tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("NVRTC 13.0 cannot compile gather.cu for sm_90:\nno built-in headers")

    install_gpus(monkeypatch, [(9, 0)], FakeDriver())
    monkeypatch.setattr(cuda_compile, "supported_architectures", lambda: [90])
    monkeypatch.setattr(cuda_compile, "cache_folder", lambda: None)
    monkeypatch.setattr(cuda_compile, "compile_kernels", fail)
    lines = report(caplog, tmp_path, tmp_path)
    assert lines["cuda:0"] == "GPU 0, 1.0 GiB, compute capability 9.0"
    reason = "NVRTC 13.0 cannot compile gather.cu for sm_90: no built-in headers"
    assert lines["CUDA kernels"] == f"not available; on cuda:0 the reference in PyTorch is used: {reason}"
    assert "CUDA kernels" in lines["end"]


def test_many_names_are_cut():
    names = [str(number) for number in range(20)]
    assert doctor._listed(names) == "0, 1, 2, 3, 4, 5, 6, 7 and 12 more"


def test_a_broken_section_does_not_end_the_report(caplog, tmp_path, monkeypatch):
    monkeypatch.setattr(doctor, "_native", lambda: 1 / 0)
    lines = report(caplog, tmp_path, tmp_path)
    assert lines["error"] == "ZeroDivisionError: division by zero"
    assert "libigl" in lines
    assert "error" in lines["end"]


def test_it_runs_without_pytorch(tmp_path):
    code = "import sys; sys.modules['torch'] = None; from snarfcli.cli.main import main; raise SystemExit(main(['doctor']))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "cannot be used: torch is not installed" in done.stdout
    assert "libigl" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr


def test_as_a_command(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["doctor", "data_root=elsewhere"]) == 0
    assert cli.main(["doctor", "data_rot=x"]) == 2
    assert "did you mean 'data_root'" in capsys.readouterr().err


@pytest.mark.parametrize("setting", ["up=y", "hands=released", "rest=file", "mapping=m.json", "clip=walk"])
def test_settings_of_motions_need_one(capsys, setting):
    assert cli.main(["doctor", setting]) == 2
    assert (
        f"{setting.partition('=')[0]}: wanted a motion file to use it with, got none; add --pose FILE"
        in capsys.readouterr().err
    )
