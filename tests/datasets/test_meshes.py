"""Subjects that users provide: all formats give the same subject, and errors are named."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_animal import ANIMAL_CLIPS, Animal, AnimalMotion, animal_motion, make_animal
from toy_animal_files import animal_glb, write_animal_bvh, write_animal_meshes, write_mesh

from snarfcli.bodies.extent import bone_owners, bone_segments, weight_segments
from snarfcli.datasets import meshes
from snarfcli.datasets.recorded_sequence import FileToWorld
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.datasets.subjects import SubjectData
from snarfcli.deformer import BonePrior
from snarfcli.errors import UserError
from snarfcli.samples.preprocessing import preprocess_subject
from snarfcli.samples.store import SampleStore
from snarfcli.samples.stored_motion import stored_motion
from snarfcli.sampling import SamplingSettings

FRAMES = 5
SAMPLING = SamplingSettings(points_per_frame=80, surface_noise_m=0.01, padding=0.1, inside_test="winding", seed=0)
ROUTES = ("glb", "glb in a folder", "poses", "transforms", "json", "bvh motion", "bvh skeleton", "bvh alone")


def motions(*names: str) -> list[AnimalMotion]:
    return [animal_motion(name, FRAMES) for name in names or ANIMAL_CLIPS]


def request(folder: Path, **settings) -> Request:
    return Request(DataConfig("meshes", 1, 1, 1, folder=str(folder), **settings), Path("nowhere"))


def transforms_of(animal: Animal, motion: AnimalMotion) -> np.ndarray:
    """Return what moves a point at rest with each joint."""
    moved = animal.place(motion.poses, motion.translation)
    moved[..., :3, 3] -= np.einsum("tjab,jb->tja", moved[..., :3, :3], animal.joints)
    return moved


def write(folder: Path, route: str, animal: Animal, chosen: list[AnimalMotion]) -> None:
    """Write the subject `rex` in one of the ways there are."""
    rex = folder / "rex"
    folder.mkdir(parents=True, exist_ok=True)
    if route.startswith("glb"):
        (rex if "folder" in route else folder).mkdir(exist_ok=True)
        (rex / "a.glb" if "folder" in route else folder / "rex.glb").write_bytes(animal_glb(animal, chosen))
        return
    write_animal_meshes(rex, animal, chosen)
    for motion in chosen:
        place = rex / motion.name
        if route == "transforms":
            np.savez(place / "poses.npz", bone_transforms=transforms_of(animal, motion), frame_rate=30)
        if route == "json":
            (place / "poses.npz").unlink()
            content = {"poses": motion.poses.tolist(), "translation": motion.translation.tolist()}
            (place / "poses.json").write_text(json.dumps(content))
        if route.startswith("bvh"):
            (place / "poses.npz").unlink()
            write_animal_bvh(place / "motion.bvh", animal, motion)
    if route == "json":
        parents = [None if parent < 0 else animal.names[parent] for parent in animal.parents]
        content = {"names": list(animal.names), "parents": parents, "joints_rest": animal.joints.tolist()}
        (rex / "skeleton.json").write_text(json.dumps(content))
    if route in ("json", "bvh skeleton", "bvh alone"):
        (rex / "skeleton.npz").unlink()
    if route == "bvh skeleton":
        write_animal_bvh(rex / "skeleton.bvh", animal, chosen[0])


@pytest.fixture(scope="module")
def animal() -> Animal:
    return make_animal(0.08)


@pytest.fixture(scope="module")
def routes(animal, tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("routes")
    for route in ROUTES:
        write(root / route, route, animal, motions())
    return {route: root / route for route in ROUTES}


def same_subject(one: SubjectData, other: SubjectData) -> None:
    """The joints may be in another order."""
    columns = [other.skeleton.names.index(name) for name in one.skeleton.names]
    assert [one.skeleton.names[p] if p >= 0 else "" for p in one.skeleton.parents] == [
        other.skeleton.names[other.skeleton.parents[c]] if other.skeleton.parents[c] >= 0 else "" for c in columns
    ]
    # BVH holds nine digits, glTF float32
    np.testing.assert_allclose(one.skeleton.joints_rest, other.skeleton.joints_rest[columns], atol=3e-7)
    assert len(one.sequences) == len(other.sequences)
    for mine, theirs in zip(one.sequences, other.sequences, strict=True):
        assert (mine.name, mine.split, mine.posed_from_rest) == (theirs.name, theirs.split, theirs.posed_from_rest)
        assert mine.motion.frame_rate == pytest.approx(theirs.motion.frame_rate)
        np.testing.assert_allclose(mine.motion.poses, theirs.motion.poses[:, columns], atol=1e-6)
        np.testing.assert_allclose(mine.motion.translation, theirs.motion.translation, atol=1e-6)
        for frame in range(FRAMES):
            np.testing.assert_allclose(mine.meshes[frame][0], theirs.meshes[frame][0], atol=1e-6)
            np.testing.assert_array_equal(mine.meshes[frame][1], theirs.meshes[frame][1])


@pytest.mark.parametrize("route", ROUTES)
def test_every_route_gives_the_same_subject(routes, route):
    assert meshes.subjects(request(routes[route])) == ("rex",)
    subject = meshes.load("rex", request(routes[route]))
    assert [(spec.name, spec.split) for spec in subject.sequences] == [
        ("sit", "train"), ("sniff", "train"), ("trot", "train"), ("walk", "test"),
    ]  # fmt: skip
    assert any("scaled by" in line for line in subject.sources)
    assert not subject.broken
    assert np.ptp(subject.sequences[0].meshes[0][0], axis=0).max() == pytest.approx(1.8, rel=1e-3)
    assert (subject.template is None) == (not route.startswith("glb"))
    same_subject(meshes.load("rex", request(routes["poses"])), subject)


def test_equal_numbers_give_equal_samples(routes, tmp_path):
    stores = []
    for route in ("poses", "transforms", "bvh motion"):
        subject = meshes.load("rex", request(routes[route]))
        preprocess_subject(subject, tmp_path / route, SAMPLING, {"train": 1, "test": 1, "ood": 1}, sequences=["sit"])
        stores.append(SampleStore.open(tmp_path / route, "meshes", "rex"))
    first = stores[0].sequences("train")[0]
    for store in stores[1:]:
        other = store.sequences("train")[0]
        for name in ("points.npy", "occupancies.npy", "vertices.npy", "faces.npy"):
            assert (first.folder / name).read_bytes() == (other.folder / name).read_bytes()
        np.testing.assert_allclose(first.bone_transforms, other.bone_transforms, atol=1e-6)


def test_other_units_and_axes_make_no_difference(routes, animal, tmp_path):
    """The same animal in centimetres and z up."""
    turn = FileToWorld(100.0, "z").turn.T  # from y up to z up
    rex = tmp_path / "rex"
    shutil.copytree(routes["poses"] / "rex", rex)
    skeleton = {"names": animal.names, "parents": animal.parents, "joints_rest": 100 * animal.joints @ turn.T, "up": "z"}
    np.savez(rex / "skeleton.npz", **{name: np.array(value) for name, value in skeleton.items()})
    for motion in motions():
        arrays = {"poses": motion.poses @ turn.T, "trans": 100 * motion.translation @ turn.T, "frame_rate": 30}
        np.savez(rex / motion.name / "poses.npz", **arrays)
        for frame, vertices in enumerate(animal.posed(motion)):
            write_mesh(rex / motion.name / f"frame_{frame}.obj", 100 * vertices @ turn.T, animal.faces)
    same_subject(meshes.load("rex", request(routes["poses"])), meshes.load("rex", request(tmp_path)))
    transforms = FileToWorld(1.0, "z").transforms(transforms_of(animal, motions()[0]))
    point = np.array([0.1, 0.2, 0.3, 1.0])
    turned = FileToWorld(1.0, "z").matrix @ point
    expected = FileToWorld(1.0, "z").matrix @ transforms_of(animal, motions()[0])[3, 5] @ point
    np.testing.assert_allclose(transforms[3, 5] @ turned, expected, atol=1e-12)


@pytest.mark.parametrize(("scale", "length"), [("auto", 1.8), ("1", 1.19), ("2.5", 2.97)])
def test_scale_is_chosen(routes, scale, length):
    subject = meshes.load("rex", request(routes["glb"], scale=scale))
    assert np.ptp(subject.template.vertices, axis=0).max() == pytest.approx(length, abs=0.01)


def test_topology_may_change_and_meshes_may_have_holes(animal, tmp_path):
    write(tmp_path, "poses", animal, motions("walk", "sit"))
    for frame in range(FRAMES):
        other = make_animal(0.08 + 0.005 * frame)
        vertices = other.posed(animal_motion("walk", FRAMES))[frame]
        write_mesh(tmp_path / "rex" / "walk" / f"frame_{frame}.obj", vertices, other.faces[4 * frame :])
    subject = meshes.load("rex", request(tmp_path, test=["sit"]))
    preprocess_subject(subject, tmp_path / "data", SAMPLING, {"train": 1, "test": 1, "ood": 1})
    (walk,) = SampleStore.open(tmp_path / "data", "meshes", "rex").sequences("train")
    assert len({len(walk.vertices(frame)) for frame in range(FRAMES)}) > 2
    assert walk.description["boundary_edges"] > 0
    inside = [walk.occupancies(frame)[40:].mean() for frame in range(FRAMES)]
    assert 0.25 < min(inside) <= max(inside) < 0.75  # near the surface; a hole empties nothing


def test_transforms_that_stretch_are_kept(animal, tmp_path, caplog):
    write(tmp_path, "transforms", animal, motions("walk", "sit"))
    motion = animal_motion("walk", FRAMES)
    moved = transforms_of(animal, motion)
    moved[2:, 4, :3, :3] *= 1.5  # a swelling head
    np.savez(tmp_path / "rex" / "walk" / "poses.npz", bone_transforms=moved)
    subject = meshes.load("rex", request(tmp_path, scale="1"))
    kept = {spec.name: spec.posed_from_rest for spec in subject.sequences}
    assert kept["sit"] is None
    assert any("stretch" in line and "walk" in line for line in subject.sources)
    np.testing.assert_allclose(kept["walk"], moved)
    preprocess_subject(subject, tmp_path / "data", SAMPLING, {"train": 1, "test": 1, "ood": 1})
    store = SampleStore.open(tmp_path / "data", "meshes", "rex")
    np.testing.assert_allclose(store.sequences("test")[0].bone_transforms, moved, atol=1e-6)
    with caplog.at_level(logging.INFO):
        motion, transforms = stored_motion(str(tmp_path / "data"), "meshes", "rex", None, store.skeleton)
    assert "motion=walk is taken; there are also sit" in caplog.text
    assert motion.name == "walk"
    assert motion.num_frames == FRAMES
    np.testing.assert_allclose(transforms, moved, atol=1e-6)
    assert stored_motion(str(tmp_path / "data"), "meshes", "rex", "sit", store.skeleton)[1] is None
    with pytest.raises(UserError, match="no sequence 'sti'; did you mean 'sit'"):
        stored_motion(str(tmp_path / "data"), "meshes", "rex", "sti", store.skeleton)
    with pytest.raises(
        UserError, match=r"no motion for this skeleton .*snarf preprocess data=meshes subject=fox.* --pose FILE"
    ):
        stored_motion(str(tmp_path / "data"), "meshes", "fox", None, store.skeleton)


# ---------------------------------------------------------------- splits, names, layouts
@pytest.mark.parametrize(
    ("settings", "split_file", "expected"),
    [
        ({}, None, {"sit": "train", "sniff": "train", "trot": "train", "walk": "test"}),
        ({"test": ["s*"]}, None, {"sit": "test", "sniff": "test", "trot": "train", "walk": "train"}),
        ({}, {"test": ["sit"], "ood": ["trot"]}, {"sit": "test", "sniff": "train", "trot": "ood", "walk": "train"}),
        ({"test": ["walk"]}, {"test": ["sit"]}, {"sit": "train", "sniff": "train", "trot": "train", "walk": "test"}),
    ],
)
def test_sequences_are_held_out(routes, tmp_path, settings, split_file, expected):
    shutil.copytree(routes["glb in a folder"], tmp_path / "data")
    if split_file is not None:
        (tmp_path / "data" / "rex" / "split.json").write_text(json.dumps(split_file))
    subject = meshes.load("rex", request(tmp_path / "data", **settings))
    assert {spec.name: spec.split for spec in subject.sequences} == expected
    assert [spec.split for spec in subject.sequences] == sorted(expected.values(), key=("train", "test", "ood").index)


@pytest.mark.parametrize("route", ["glb", "poses", "transforms"])
def test_the_end_of_an_only_sequence_is_held_out(animal, tmp_path, route):
    write(tmp_path, route, animal, motions("walk"))
    train, test = meshes.load("rex", request(tmp_path)).sequences
    assert (train.name, train.split, train.motion.num_frames) == ("walk", "train", 4)
    assert (test.name, test.split, test.motion.num_frames, len(test.meshes)) == ("walk_end", "test", 1, 1)
    assert test.motion.poses[0] == pytest.approx(animal_motion("walk", FRAMES).poses[-1], abs=1e-6)
    assert len(test.meshes[0][0]) == len(animal.vertices)


def test_one_sequence_may_lie_beside_the_skeleton(animal, tmp_path):
    write_animal_meshes(tmp_path / "rex", animal, motions("walk"))
    for path in (tmp_path / "rex" / "walk").iterdir():
        path.rename(tmp_path / "rex" / path.name)
    (tmp_path / "rex" / "walk").rmdir()
    for folder in (tmp_path, tmp_path / "rex"):  # the folder of subjects, or the subject's own
        assert meshes.subjects(request(folder)) == ("rex",)
        assert [spec.name for spec in meshes.load("rex", request(folder)).sequences] == ["rex", "rex_end"]


def test_the_canonical_pose_is_the_files_or_the_rest(routes, animal, tmp_path):
    shutil.copytree(routes["json"], tmp_path / "data")
    path = tmp_path / "data" / "rex" / "skeleton.json"
    pose = np.zeros((19, 3))
    pose[4, 0] = 0.3
    path.write_text(json.dumps(json.loads(path.read_text()) | {"canonical_pose": pose.tolist()}))
    for canonical, angle in (("auto", 0.3), ("rest", 0.0)):
        subject = meshes.load("rex", request(tmp_path / "data", canonical=canonical))
        assert float(subject.skeleton.canonical_pose[4, 0]) == pytest.approx(angle)
    with pytest.raises(UserError, match="legs_apart: wanted joints named l_hip and r_hip"):
        meshes.load("rex", request(tmp_path / "data", canonical="legs_apart"))


def test_legs_apart_moves_the_template_of_a_rig(animal, tmp_path):
    names = tuple({"l_hind_upper": "l_hip", "r_hind_upper": "r_hip"}.get(name, name) for name in animal.names)
    (tmp_path / "rex.glb").write_bytes(animal_glb(replace(animal, names=names), motions()))
    rest = meshes.load("rex", request(tmp_path)).template.vertices
    apart = meshes.load("rex", request(tmp_path, canonical="legs_apart"))
    assert np.ptp(apart.template.vertices[:, 0]) > 1.3 * np.ptp(rest[:, 0])


# ---------------------------------------------------------------- rigged files
def with_leaf(animal: Animal, chosen: list[AnimalMotion]) -> tuple[Animal, list[AnimalMotion]]:
    """Add a joint, and one below it, that move nothing."""
    more = replace(
        animal,
        names=(*animal.names, "ear", "ear_end"),
        parents=(*animal.parents, 4, 19),
        joints=np.concatenate([animal.joints, animal.joints[[4, 4]] + [[0, 0.1, 0], [0, 0.2, 0]]]),
        weights=np.pad(animal.weights, ((0, 0), (0, 2))),
    )
    return more, [replace(motion, poses=np.pad(motion.poses, ((0, 0), (0, 2), (0, 0)))) for motion in chosen]


def test_last_joints_that_move_nothing_are_left_out(routes, animal, tmp_path):
    (tmp_path / "rex.glb").write_bytes(animal_glb(*with_leaf(animal, motions())))
    subject = meshes.load("rex", request(tmp_path))
    assert any(line.startswith("left out 2 end joints without vertices (ear, ear_end)") for line in subject.sources)
    assert subject.template.weights.shape[1] == subject.skeleton.num_joints == 19
    same_subject(meshes.load("rex", request(routes["glb"])), subject)


def test_a_root_on_the_floor_that_moves_nothing_is_idle(animal, tmp_path):
    """As artists' rigs have one below the animal: it gets no bone in the shape, and no weights to start from."""
    rooted = replace(
        animal,
        names=("root", *animal.names),
        parents=(-1, *(parent + 1 for parent in animal.parents)),
        joints=np.concatenate([[[0.0, 0.0, 0.0]], animal.joints]),
        weights=np.pad(animal.weights, ((0, 0), (1, 0))),
    )
    chosen = [replace(motion, poses=np.pad(motion.poses, ((0, 0), (1, 0), (0, 0)))) for motion in motions()]
    (tmp_path / "rex.glb").write_bytes(animal_glb(rooted, chosen))
    subject = meshes.load("rex", request(tmp_path))
    assert subject.skeleton.idle == (0,)
    assert any("get no weights and no shape: root" in line for line in subject.sources)
    assert len(bone_segments(subject.skeleton)) == len(bone_owners(subject.skeleton)) == len(animal.names) - 1
    assert 0 not in bone_owners(subject.skeleton)
    segments, owner = weight_segments(subject.skeleton, continued=True)
    logits = BonePrior(segments, owner, subject.skeleton.num_joints, 0.01)(subject.skeleton.canonical_joints[:1])
    assert logits.softmax(-1)[0, 0] == 0  # although the point is at the root
    assert torch.isfinite(logits).all()
    preprocess_subject(subject, tmp_path, SAMPLING, {"train": 1, "test": 1, "ood": 1})
    assert SampleStore.open(tmp_path, "meshes", "rex").skeleton.idle == (0,)
    again = type(subject.skeleton).from_dict(subject.skeleton.to_dict())
    assert again.idle == subject.skeleton.to(torch.float32).idle == (0,)
    with pytest.raises(ValueError, match="idle: wanted some joints"):
        replace(subject.skeleton, idle=(99,))


def test_clips_of_several_files_are_joined(routes, animal, tmp_path):
    (tmp_path / "rex").mkdir()
    for name in ("sit", "sniff"):  # one clip a file, all of the same name
        (tmp_path / "rex" / f"{name}.glb").write_bytes(animal_glb(animal, [replace(motions(name)[0], name="take 1")]))
    more, chosen = with_leaf(animal, [replace(motion, name=motion.name.title()) for motion in motions("trot", "walk")])
    (tmp_path / "rex" / "zoo.glb").write_bytes(animal_glb(more, chosen))
    subject = meshes.load("rex", request(tmp_path))
    assert [spec.name for spec in subject.sequences] == ["sit", "sniff", "zoo_Trot", "zoo_Walk"]
    wanted = meshes.load("rex", request(routes["glb"]))
    for mine, theirs in zip(subject.sequences, wanted.sequences, strict=True):
        np.testing.assert_allclose(mine.motion.poses, theirs.motion.poses, atol=1e-6)


def test_a_damaged_file_leaves_the_others_usable(animal, tmp_path):
    (tmp_path / "rex").mkdir()
    for name in ("sit", "sniff"):
        (tmp_path / "rex" / f"{name}.glb").write_bytes(animal_glb(animal, motions(name)))
    (tmp_path / "rex" / "broken.glb").write_bytes(b"glTF and then nothing")
    subject = meshes.load("rex", request(tmp_path))
    assert sorted(spec.name for spec in subject.sequences) == ["sit", "sniff"]
    assert any("broken" in line for line in subject.warnings)


def test_files_of_two_skeletons_are_told_apart(animal, tmp_path):
    (tmp_path / "rex").mkdir()
    (tmp_path / "rex" / "a.glb").write_bytes(animal_glb(animal, motions("sit")))
    other = replace(animal, names=("hips", *animal.names[1:]))
    (tmp_path / "rex" / "b.glb").write_bytes(animal_glb(other, motions("walk")))
    with pytest.raises(UserError, match=r"b.glb has no joint 'pelvis', which a.glb has"):
        meshes.load("rex", request(tmp_path))
    joints = animal.joints.copy()
    joints[4] += (0, 0.3, 0)
    (tmp_path / "rex" / "b.glb").write_bytes(animal_glb(replace(animal, joints=joints), motions("walk")))
    with pytest.raises(UserError, match=r"b.glb: 'head': wanted the distance to its parent of a.glb"):
        meshes.load("rex", request(tmp_path))


def test_a_rig_without_animation_is_refused(animal, tmp_path):
    (tmp_path / "rex.glb").write_bytes(animal_glb(animal, []))
    with pytest.raises(UserError, match=r"rex.glb has no animations, but an avatar is learned from them"):
        meshes.load("rex", request(tmp_path))


# ---------------------------------------------------------------- what is wrong is named
def test_sequences_that_cannot_be_used_are_listed(animal, tmp_path):
    write(tmp_path, "poses", animal, motions())
    rex = tmp_path / "rex"
    (rex / "sit" / "frame_3.obj").unlink()
    (rex / "sniff" / "poses.npz").unlink()
    np.savez(rex / "trot" / "poses.npz", poses=np.full((FRAMES, 57), np.nan))
    subject = meshes.load("rex", request(tmp_path))
    assert [(spec.name, spec.split) for spec in subject.sequences] == [("walk", "test")]  # as if all were whole
    reasons = dict(subject.broken)
    assert "wanted 5 meshes, one per frame of poses.npz, got 4" in reasons["sit"]
    assert "wanted one pose file (poses.npz, poses.json, motion.bvh), got none" in reasons["sniff"]
    assert "poses: wanted finite numbers" in reasons["trot"]
    (rex / "walk" / "poses.npz").write_bytes(b"")
    with pytest.raises(UserError, match=r"\(and 3 more sequences cannot be used\)"):
        meshes.load("rex", request(tmp_path))


def test_a_motion_of_another_skeleton_is_named(animal, tmp_path):
    write(tmp_path, "bvh motion", animal, motions())
    other = replace(animal, names=("hips", *animal.names[1:]))
    write_animal_bvh(tmp_path / "rex" / "sit" / "motion.bvh", other, animal_motion("sit", FRAMES))
    larger = replace(animal, joints=2 * animal.joints)
    write_animal_bvh(tmp_path / "rex" / "trot" / "motion.bvh", larger, animal_motion("trot", FRAMES))
    reasons = dict(meshes.load("rex", request(tmp_path)).broken)
    assert "sit/motion.bvh has no joint 'pelvis'" in reasons["sit"]
    assert "at rest: wanted the position of the skeleton" in reasons["trot"]


def test_what_is_missing_is_said(animal, tmp_path):
    with pytest.raises(UserError, match=r"the folder of meshes .*nothing does not exist; give data.folder=FOLDER"):
        meshes.subjects(request(tmp_path / "nothing"))
    with pytest.raises(UserError, match=r"no subject in .*; wanted a rigged <subject>.glb"):
        meshes.subjects(request(tmp_path))
    (tmp_path / "cat").mkdir()
    with pytest.raises(UserError, match=r"no subject in .*cat has no skeleton: wanted skeleton.json"):
        meshes.subjects(request(tmp_path))
    with pytest.raises(UserError, match=r"cat has no skeleton"):
        meshes.load("cat", request(tmp_path))
    write(tmp_path, "poses", animal, motions("sit"))
    assert meshes.subjects(request(tmp_path)) == ("rex",)
    with pytest.raises(UserError, match=r"got the file /a b/cat.glb; give 'data.folder=/a b' subject=cat"):
        meshes.load("/a b/cat.glb", request(tmp_path))
    with pytest.raises(UserError, match=r"no subject 'rax' in .*; did you mean 'rex'"):
        meshes.load("rax", request(tmp_path))
    with pytest.raises(UserError, match=r"data.up: wanted auto, y or z, got 'x'"):
        meshes.load("rex", request(tmp_path, up="x"))
    with pytest.raises(UserError, match=r"data.scale: wanted auto or metres per unit .* got 'cm'"):
        meshes.load("rex", request(tmp_path, scale="cm"))
    with pytest.raises(UserError, match=r"data.test: no sequence 'wlak'"):
        meshes.load("rex", request(tmp_path, test=["wlak"]))
    (tmp_path / "rex" / "split.json").write_text('{"tests": []}')
    with pytest.raises(UserError, match=r"split.json: wanted an object such as"):
        meshes.load("rex", request(tmp_path))
    (tmp_path / "rex" / "split.json").unlink()
    shutil.copy(tmp_path / "rex" / "skeleton.npz", tmp_path / "rex" / "skeleton.json")
    with pytest.raises(UserError, match=r"wanted one skeleton, got skeleton.json and skeleton.npz; remove one"):
        meshes.load("rex", request(tmp_path))


def test_skeletons_are_float64_and_finite(routes):
    skeleton = meshes.load("rex", request(routes["glb"])).skeleton
    assert skeleton.joints_rest.dtype == skeleton.canonical_pose.dtype == torch.float64
