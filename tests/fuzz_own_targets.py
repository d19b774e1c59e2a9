"""Targets of the fuzzer for the formats of this package: avatars, checkpoints, samples, records and meshes."""

from __future__ import annotations

import hashlib
import io
import json
import random
import struct
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_damage import DAMAGES
from fuzzing import Target

__all__ = ["OWN_TARGETS"]


def _avatar_target(name: str, read: Callable[[Path], object]) -> Target:
    from tiny_avatars import KINDS, saved, tiny_avatar
    from tree_damage import damaged_torch

    return Target(name, ".pt", lambda: [saved(tiny_avatar(kind).to_dict()) for kind in KINDS], read, damaged_torch, 0.8, cost=4)


def avatar() -> Target:
    """Files of avatars of every system."""
    from snarfcli.avatar import Avatar

    return _avatar_target("avatar", Avatar.load)


def avatar_use() -> Target:
    """Files of avatars, which are queried, meshed and turned into a character."""
    return _avatar_target("avatar_use", use_avatar)


def safetensors() -> Target:
    """Files of safetensors by themselves."""
    from snarfcli.formats.safetensors import read_safetensors, safetensors_bytes

    def seeds() -> list[bytes]:
        arrays = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.array([True, False]), "n": np.array(3)}
        return [safetensors_bytes(arrays, {"format": "pt"}), safetensors_bytes({"e": np.zeros((0, 2))}, {})]

    return Target("safetensors", ".safetensors", seeds, read_safetensors, _damaged_header)


def _damaged_header(rng: random.Random, content: bytes) -> bytes:
    """Damage the tree of the header of a file of safetensors; its length fits again."""
    from tree_damage import damaged_json

    (length,) = struct.unpack_from("<Q", content)
    header = damaged_json(rng, content[8 : 8 + length])
    return struct.pack("<Q", len(header)) + header + content[8 + length :]


def pretrained() -> Target:
    """Folders of `Avatar.save_pretrained`."""
    from tiny_avatars import KINDS, tiny_avatar

    from snarfcli.avatar import Avatar

    def seeds() -> list[bytes]:
        made = []
        for kind in KINDS:
            with tempfile.TemporaryDirectory() as folder:
                tiny_avatar(kind).save_pretrained(folder)
                made.append(_packed(Path(folder)))
        return made

    return Target(
        "pretrained", ".pretrained", seeds, Avatar.from_pretrained, _damaged_pretrained, cost=4, unpack=_unpack_pretrained
    )


def _unpack_pretrained(content: bytes, scratch: Path) -> Path:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(scratch)
    return scratch


def _damaged_pretrained(rng: random.Random, content: bytes) -> bytes:
    """Damage the tensors or the configuration of an avatar; in most cases the checksum in the configuration fits again."""
    from tree_damage import damaged_array, damaged_json

    from snarfcli.formats.safetensors import read_safetensors, safetensors_bytes

    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    tensors, config = "model.safetensors", "config.json"
    kind = rng.random()
    if kind < 0.15:
        files[tensors] = rng.choice(DAMAGES)(rng, files[tensors], b"")
    elif kind < 0.3:
        files[tensors] = _damaged_header(rng, files[tensors])
    elif kind < 0.7:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / tensors).write_bytes(files[tensors])
            arrays, metadata = read_safetensors(Path(folder) / tensors)
        for _ in range(rng.choice([1, 1, 2])):
            name = rng.choice(sorted(arrays))
            try:
                changed = {**arrays, name: damaged_array(rng, arrays[name])}
                files[tensors] = safetensors_bytes(changed, metadata)
                arrays = changed
            except Exception:  # a type that the format has not
                del arrays[name]
                files[tensors] = safetensors_bytes(arrays, metadata)
    if rng.random() < 0.9:
        described = json.loads(files[config])
        described["weights"]["sha256"] = hashlib.sha256(files[tensors]).hexdigest()
        files[config] = json.dumps(described).encode()
    if kind > 0.6:
        files[config] = damaged_json(rng, files[config])
    if rng.random() < 0.03:
        del files[rng.choice(sorted(files))]
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def use_avatar(path: Path) -> object:
    """Load an avatar and use it in every way: occupancy, weights, meshes, the content of a `.glb`."""
    import torch

    from snarfcli.avatar import Avatar
    from snarfcli.errors import UserError
    from snarfcli.export.character import CharacterOptions
    from snarfcli.export.character_build import build_character
    from snarfcli.export.character_glb import character_glb
    from snarfcli.export.character_surface import character_surface
    from snarfcli.export.clips import Clip
    from snarfcli.meshing.extract import EmptySurface, FullSurface
    from snarfcli.motions import Motion

    avatar = Avatar.load(path)
    joints = avatar.skeleton.num_joints
    pose = 0.1 * torch.ones(joints, 3)
    avatar.occupancy(torch.zeros(1, 5, 3), pose[None])
    options = CharacterOptions(triangles=60, resolution=8, morph_targets=1)
    try:
        avatar.mesh(pose, resolution=8)
        if avatar.has_skinning_weights:
            avatar.skinning_weights(torch.zeros(5, 3))
        if avatar.has_skinning_weights and avatar.model.has_canonical_shape:
            avatar.mesh(pose, resolution=8, surface="skinned")
            motion = Motion("still", np.zeros((2, joints, 3)), np.zeros((2, 3)), 30.0)
            character = build_character(avatar, character_surface(avatar, options), [Clip(motion)], options)
            character_glb(character, avatar.skeleton.names, avatar.skeleton.parents)[0].to_bytes()
    except (EmptySurface, FullSurface):  # an honest answer of any avatar
        return None
    except UserError as error:  # such as NaN in the field, which does not know its file
        raise UserError(f"{path}: {error}") from None
    return avatar


@cache
def _toy_samples() -> tuple[Path, Any]:
    """Return the folder of the samples of a small subject, in a folder that is removed at exit, and the store."""
    import atexit
    import shutil

    from toy_training import toy_store

    root = Path(tempfile.mkdtemp(prefix="snarf-fuzz-samples-"))
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    store = toy_store(root, points=16, frames=3)
    return store.folder, store


def checkpoint() -> Target:
    """Checkpoints, with a step of training after each is restored."""
    import torch
    from tiny_avatars import saved
    from toy_training import avatar_config, new_avatar, training_config
    from tree_damage import damaged_torch

    from snarfcli.models.checkpoint import load_checkpoint
    from snarfcli.training.trainer import CHECKPOINT_FORMAT, CHECKPOINT_VERSION, Trainer

    store = _toy_samples()[1]
    config = training_config(steps=20, uniform_points=8, surface_points=8, far_points=2, refine_poses=True, bone_points=2)

    def trainer() -> Trainer:
        torch.manual_seed(0)
        small = avatar_config(capsules=True)
        small.skinning.resolution, small.skinning.width, small.shape.width = [5, 4, 4], 4, 4
        return Trainer(new_avatar(store, small), store, config, 0, torch.device("cpu"))

    def seeds() -> list[bytes]:
        first, later = trainer(), trainer()
        later.advance()
        return [saved(one.state()) for one in (first, later)]

    def read(path: Path) -> object:
        again = trainer()
        again.restore(load_checkpoint(path, CHECKPOINT_FORMAT, CHECKPOINT_VERSION, "checkpoint"), str(path))
        return again.advance()

    return Target("checkpoint", ".pt", seeds, read, damaged_torch, 0.8, cost=4)


def _packed(folder: Path) -> bytes:
    """Return the files of a folder as one archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, path.relative_to(folder))
    return buffer.getvalue()


def _unpack_samples(content: bytes, scratch: Path) -> Path:
    """Write the files of samples below a folder, and return the folder of the subject."""
    folder = scratch / "processed" / "builtin" / "toy"
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(folder)
    return folder


def _damaged_samples(rng: random.Random, content: bytes) -> bytes:
    """Damage one or two files of samples; in most cases the sizes and checksums in the descriptions fit again."""
    from tree_damage import damaged_array, damaged_json, damaged_npz

    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    for _ in range(rng.choice([1, 1, 2])):
        name = rng.choice([name for name in sorted(files) if not name.endswith(".json")])
        if rng.random() < 0.3:
            files[name] = rng.choice(DAMAGES)(rng, files[name], b"")
        elif name.endswith(".npz"):
            try:
                files[name] = damaged_npz(rng, files[name])
            except Exception:  # damaged before; NumPy raises many kinds
                files[name] = b""
        else:
            try:
                array = damaged_array(rng, np.load(io.BytesIO(files[name])))
            except Exception:
                array = np.zeros(3)
            buffer = io.BytesIO()
            np.save(buffer, array)
            files[name] = buffer.getvalue()
        if rng.random() < 0.8:
            _describe_again(files)
    if rng.random() < 0.5:
        name = rng.choice([name for name in sorted(files) if name.endswith(".json")])
        files[name] = damaged_json(rng, files[name])
    if rng.random() < 0.05:
        del files[rng.choice(sorted(files))]
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def _describe_again(files: dict[str, bytes]) -> None:
    """Correct the sizes and checksums of files in the descriptions."""
    manifest = json.loads(files["manifest.json"])
    described = [("", manifest)] + [(f"{one['split']}/{one['name']}/", one) for one in manifest["sequences"]]
    for place, entry in described:
        for name, about in entry["files"].items():
            data = files[place + name]
            about |= {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        if place:
            own = json.loads(files[f"{place}sequence.json"])
            files[f"{place}sequence.json"] = json.dumps({**own, "files": entry["files"]}).encode()
    files["manifest.json"] = json.dumps(manifest).encode()


def _samples_target(name: str, read: Callable[[Path], object]) -> Target:
    return Target(
        name, ".samples", lambda: [_packed(_toy_samples()[0])], read, _damaged_samples, cost=4, unpack=_unpack_samples
    )


def samples() -> Target:
    """Processed samples: opened, read, verified, and their motion taken."""
    from snarfcli.bodies import Skeleton
    from snarfcli.samples.store import SampleStore
    from snarfcli.samples.stored_motion import stored_motion

    skeleton: Skeleton = _toy_samples()[1].skeleton

    def read(folder: Path) -> object:
        root = folder.parents[2]
        store = SampleStore.open(root, "builtin", "toy")
        for sequence in store.all_sequences:
            for frame in range(min(2, sequence.num_frames)):
                sequence.points(frame), sequence.occupancies(frame, np.arange(3)), sequence.vertices(frame)
                sequence.faces(frame), sequence.box(frame), sequence.cube(frame)
        stored_motion(str(root), "builtin", "toy", None, skeleton)
        return store.verify()

    return _samples_target("samples", read)


def resumed_samples() -> Target:
    """Processed samples that `snarf preprocess` continues."""
    from toy_subject import toy_subject

    from snarfcli.samples.finished import complete_sequences, write_subject
    from snarfcli.samples.writing import require_same_settings

    subject, store = toy_subject(train_frames=3), _toy_samples()[1]
    settings = store.manifest["settings"]

    def read(folder: Path) -> object:
        require_same_settings(folder, settings)
        if (folder / "subject.npz").exists():
            write_subject(folder, subject, "winding")
        return complete_sequences(folder, subject, settings, {"train": 1, "test": 1, "ood": 1})

    return _samples_target("resumed_samples", read)


def refined_poses() -> Target:
    """The poses that `training.refine_poses` writes, read as the poses and the skeleton of a data set."""
    from tree_damage import damaged_npz

    from snarfcli.datasets.skeleton_files import read_poses, read_skeleton
    from snarfcli.fitting.refined_poses import RefinedPoses

    def seeds() -> list[bytes]:
        import torch

        store = _toy_samples()[1]
        poses = RefinedPoses(store.sequences("train"), store.skeleton, torch.device("cpu"))
        with tempfile.TemporaryDirectory() as folder:
            poses.write(Path(folder) / "refined_poses.npz")
            return [(Path(folder) / "refined_poses.npz").read_bytes()]

    def read(path: Path) -> object:
        return read_poses(path, read_skeleton(path).order)

    return Target("refined_poses", ".npz", seeds, read, damaged_npz, 0.8)


def _fitted(folder: Path) -> Any:
    """Write the files of a fit, and return what they were made from."""
    from toy_scans import BETAS, toy_poses

    from snarfcli.bodies import builtin_body
    from snarfcli.datasets.recorded_sequence import FileToWorld
    from snarfcli.scanned_subjects.written import FitMade, FittedFile, write_fitted, write_skeleton

    made = FitMade(BETAS, FileToWorld(0.01, "z"), {"seed": 0})
    poses, places = toy_poses(2)
    residual_m, is_trusted, unseen = np.array([0.01, np.nan]), np.array([True, False]), np.zeros((2, 24), bool)
    fitted = FittedFile(poses, places, residual_m, is_trusted, ("", "damaged"), unseen, "abc", 1.0)
    write_skeleton(folder, builtin_body().skeleton(BETAS), made)
    write_fitted(folder, fitted, made, 30.0)
    return made, fitted


def fitted_skeleton() -> Target:
    """The skeleton that `snarf fit` has written, which it continues."""
    from tree_damage import damaged_npz

    from snarfcli.scanned_subjects.written import foreign_files, read_made

    def seeds() -> list[bytes]:
        with tempfile.TemporaryDirectory() as folder:
            _fitted(Path(folder))
            return [(Path(folder) / "skeleton.npz").read_bytes()]

    def unpack(content: bytes, scratch: Path) -> Path:
        scratch.mkdir()
        (scratch / "skeleton.npz").write_bytes(content)
        return scratch

    def read(folder: Path) -> object:
        foreign_files(folder, [folder])
        made = read_made(folder)
        assert made is None or made.digest
        return made

    return Target("fitted_skeleton", ".npz", seeds, read, damaged_npz, unpack=unpack)


def fitted_poses() -> Target:
    """The poses that `snarf fit` has written, which it keeps and reports."""
    from tree_damage import damaged_npz

    from snarfcli.bodies import builtin_body
    from snarfcli.scanned_subjects.fit_report import SequenceReport
    from snarfcli.scanned_subjects.written import read_fitted

    with tempfile.TemporaryDirectory() as folder:
        made, _ = _fitted(Path(folder))
        content = (Path(folder) / "poses.npz").read_bytes()

    def unpack(content: bytes, scratch: Path) -> Path:
        scratch.mkdir()
        (scratch / "poses.npz").write_bytes(content)
        return scratch

    def read(folder: Path) -> object:
        fitted = read_fitted(folder, made, 24)
        if fitted is not None:
            report = SequenceReport("walk", 0, fitted, builtin_body().joint_names)
            assert report.line().isprintable()
            json.dumps(report.content, allow_nan=False)
        return fitted

    return Target("fitted_poses", ".npz", lambda: [content], read, damaged_npz, unpack=unpack)


def fit_report() -> Target:
    """The report of `snarf fit`, which `snarf doctor` reads."""
    from tree_damage import damaged_json

    from snarfcli.bodies import builtin_body
    from snarfcli.scanned_subjects.fit_report import SequenceReport, report_remarks, write_fit_report

    with tempfile.TemporaryDirectory() as folder:
        made, fitted = _fitted(Path(folder))
        report = SequenceReport("walk", 0, fitted, builtin_body().joint_names)
        write_fit_report(Path(folder) / "fit.json", {"subject": "me"}, made, [report], is_complete=True)
        content = (Path(folder) / "fit.json").read_bytes()

    def read(path: Path) -> object:
        remarks = report_remarks(path)
        assert all(remark.text.isprintable() for remark in remarks)
        return remarks

    return Target("fit_report", ".json", lambda: [content], read, _any_json(damaged_json))


def animation_record() -> Target:
    """The record of an animation in its folder."""
    from tree_damage import damaged_json

    from snarfcli.commands.animation_folder import RECORD, check_record

    settings = {"avatar_sha256": "a" * 64, "start": 0, "step": 1, "frame_rate": None, "in_place": False, "surface": "field"}

    def unpack(content: bytes, scratch: Path) -> Path:
        scratch.mkdir()
        (scratch / RECORD).write_bytes(content)
        return scratch

    seeds = [json.dumps({"complete": True, "settings": settings, "frames": [{"frame": 1}]}).encode()]
    return Target(
        "animation_record",
        ".json",
        lambda: seeds,
        lambda folder: check_record(folder, settings),
        _any_json(damaged_json),
        unpack=unpack,
    )


def _any_json(damaged: Any) -> Any:
    """Return damage of the tree of a JSON file, or of its bytes."""

    def extra(rng: random.Random, content: bytes) -> bytes:
        return damaged(rng, content) if rng.random() < 0.6 else rng.choice(DAMAGES)(rng, content, b'{"settings": []}')

    return extra


def _planned() -> Any:
    from snarfcli.reproduce.plans import EvaluationStage, Job, SamplesStage

    stage = EvaluationStage("id", "builtin", "data", ("eval", "subject=1"), "outputs/eval/metrics.json", {"max_frames": None})
    samples = (SamplesStage("data/processed/builtin/1", ("preprocess", "subject=1")),)
    folder, digest = "outputs/builtin/1/x", "0" * 64
    return Job("snarf", "SNARF", "builtin", "1", 0, folder, samples, ("train",), (stage,), digest, digest[:16], 9, 1.0)


def planned_job() -> Target:
    """The plan that `snarf reproduce` gives its jobs."""
    from dataclasses import asdict

    from tree_damage import damaged_json

    from snarfcli.reproduce.planned_jobs import read_planned_job

    seeds = [json.dumps({"slots": slots, "jobs": [asdict(_planned())]}).encode() for slots in (None, 2)]
    return Target("planned_job", ".json", lambda: seeds, lambda path: read_planned_job(path, 0), damaged_json)


def job_status() -> Target:
    """The status of a run of `snarf reproduce`."""
    from dataclasses import asdict

    from tree_damage import damaged_json

    from snarfcli.reproduce.jobs import JobStatus, read_job_status

    status = JobStatus("failed", "0" * 64, trained=True, stage="train", reason="no room", seconds={"train": 3.0})

    def read(path: Path) -> object:
        found = read_job_status(path)
        assert found is None or (found.reason.isprintable() and found.digest is not None)
        return found

    return Target("job_status", ".json", lambda: [json.dumps(asdict(status)).encode()], read, damaged_json)


def durations() -> Target:
    """What `snarf reproduce` knows about the durations of runs."""
    from tree_damage import damaged_json

    from snarfcli.reproduce.durations import Durations, plan_seconds, time_text

    job = _planned()
    times = {"train_s": 60.0, "evaluations_s": 9.0, "train_processor_s": 60.0, "evaluations_processor_s": 9.0}
    duration = {**times, "threads": 1, "machine": "a processor, 2 cores", "gpu": ""}
    content = {"kinds": {job.kind: {"row": "SNARF", "runs": [duration], "steps": duration}}}

    def read(path: Path) -> object:
        estimate = Durations(path, [job], None, 1).of(job)
        return time_text(plan_seconds([estimate.total_s, estimate.processor_s], 1))

    return Target("durations", ".json", lambda: [json.dumps(content).encode()], read, damaged_json)


def metrics() -> Target:
    """Metrics of trainings and evaluations, as the reports read them."""
    from tree_damage import damaged_json

    from snarfcli.reproduce.results import COLUMNS, MORE_COLUMNS, look_up, read_metrics

    content = {
        "iou_bbox": 0.9, "iou_surface": 0.8, "steps": 10, "timings": {"seconds_per_step": 0.1, "search_ms_per_200k": 3.0},
        "sequences": {"walk": {"iou_surface": 0.8, "per_frame": {"frame": [1, 2]}}}, "machine": {"cores": 2}, "settings": {},
        "versions": {"torch": "2"}, "surfaces": {"chamfer_m": 0.001}, "weights": None, "status": "done",
    }  # fmt: skip

    def read(path: Path) -> object:
        found = read_metrics(path)
        for sequence in found.sequences.values():
            look_up(sequence, ("iou_surface",))
        return [look_up(found.content, column.path) for column in (*COLUMNS, *MORE_COLUMNS)]

    return Target("metrics", ".json", lambda: [json.dumps(content).encode()], read, damaged_json)


def _mesh_target(name: str, suffix: str) -> Target:
    from snarfcli.meshing.mesh import Mesh
    from snarfcli.meshing.mesh_files import read_mesh, write_mesh

    def seeds() -> list[bytes]:
        corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
        faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32)
        plain = Mesh(corners, faces)
        colored = Mesh(corners, faces, colors=np.arange(12).reshape(4, 3)).with_normals()
        made = []
        with tempfile.TemporaryDirectory() as folder:
            for mesh in (plain, colored):
                write_mesh(Path(folder) / f"mesh{suffix}", mesh)
                made.append((Path(folder) / f"mesh{suffix}").read_bytes())
        return made

    return Target(name, suffix, seeds, read_mesh)


def mesh_ply() -> Target:
    """Meshes of animations as PLY."""
    return _mesh_target("mesh_ply", ".ply")


def mesh_obj() -> Target:
    """Meshes of animations as OBJ."""
    return _mesh_target("mesh_obj", ".obj")


OWN_TARGETS = (avatar, avatar_use, safetensors, pretrained, checkpoint, samples, resumed_samples, refined_poses,
               fitted_skeleton, fitted_poses, fit_report, animation_record, planned_job, job_status, durations, metrics,
               mesh_ply, mesh_obj)  # fmt: skip
"""Functions that each return one target with the name of the function."""
