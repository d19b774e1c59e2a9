"""Finding the scans of subjects, and reading their frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from toy_animal import animal_motion, make_animal
from toy_animal_files import animal_glb
from toy_scans import floor, toy_mesh, write_scans

from snarfcli.datasets.mesh_folders import frame_files
from snarfcli.datasets.recorded_sequence import FileToWorld
from snarfcli.datasets.settings import DataConfig
from snarfcli.datasets.sources import Request
from snarfcli.errors import UserError
from snarfcli.files import write_arrays
from snarfcli.sampling import oriented_surface_samples
from snarfcli.scanned_subjects.scan_files import FEWEST_POINTS, examine_files, fingerprint, read_scan
from snarfcli.scanned_subjects.scans import ScanSequence, find_scans, scan_subjects
from snarfcli.scanned_subjects.surroundings import Floor


def request(root: Path, folder: Path | None = None) -> Request:
    return Request(DataConfig("meshes", 1, 1, 1, folder=None if folder is None else str(folder)), root)


def test_sequences_are_folders_with_scans(tmp_path):
    me = tmp_path / "meshes" / "me"
    write_scans(me / "walk")
    write_scans(me / "run", 1)
    (me / "notes").mkdir()
    write_scans(tmp_path / "meshes" / "you", 1)
    assert list(scan_subjects(request(tmp_path))) == ["me", "you"]
    place, folders = find_scans("me", request(tmp_path))
    assert place == me
    assert [(folder.name, len(folder.paths)) for folder in folders] == [("run", 1), ("walk", 2)]
    assert [folder.name for folder in find_scans("you", request(tmp_path))[1]] == ["you"]
    assert find_scans("me", request(tmp_path, me))[0] == me  # the folder of one subject
    assert find_scans("walk", request(tmp_path, me))[0] == me / "walk"


def test_missing_subjects_are_named(tmp_path):
    write_scans(tmp_path / "meshes" / "anna", 1)
    (tmp_path / "meshes" / "ben").mkdir()
    with pytest.raises(UserError, match=r"no subject 'ana' in .*; did you mean 'anna'"):
        find_scans("ana", request(tmp_path))
    with pytest.raises(
        UserError, match=r"no scans in .*ben; wanted <subject>/<sequence>/ with one mesh or point cloud per frame"
    ):
        find_scans("ben", request(tmp_path))
    with pytest.raises(UserError, match=r"folder of meshes .* does not exist"):
        find_scans("anna", request(tmp_path / "other"))


def test_a_rigged_file_needs_no_fit(tmp_path):
    folder = tmp_path / "meshes" / "fox"
    folder.mkdir(parents=True)
    (folder / "fox.glb").write_bytes(animal_glb(make_animal(0.06), [animal_motion("trot", 2)]))
    with pytest.raises(UserError, match=r"fox\.glb has a skin, a skeleton and its own motion, so nothing is fitted"):
        find_scans("fox", request(tmp_path))


def test_frames_are_points_in_metres_with_y_up(tmp_path):
    poses, places = write_scans(tmp_path / "walk", 2, unit_m=0.001, up="z")
    paths = tuple(sorted((tmp_path / "walk").iterdir()))
    scans = ScanSequence(paths, FileToWorld(0.001, "z"), 1500)
    assert len(scans) == 2
    vertices, _ = toy_mesh(poses[1], places[1])
    scan = scans[1]
    assert len(scan) == 1500
    assert KDTree(vertices).query(scan.points)[0].max() < 0.05
    centre = vertices.mean(0)
    assert (((scan.points - centre) * scan.normals).sum(1) > 0).mean() > 0.8  # outward
    np.testing.assert_array_equal(scans[1].points, scan.points)
    np.testing.assert_array_equal(scans.chosen([1])[0].points.shape, scan.points.shape)


def test_point_clouds_get_normals_where_they_have_none_or_wrong_ones(tmp_path):
    vertices, faces = toy_mesh(np.zeros((24, 3)), np.zeros(3))
    points, normals = oriented_surface_samples(vertices, faces, 2000, np.random.default_rng(0))
    np.savez(tmp_path / "0.npz", points=points, normals=normals)
    np.savez(tmp_path / "1.npz", points=points)
    mixed = normals * np.where(np.arange(2000) % 2, 1, -1)[:, None]
    np.savez(tmp_path / "2.npz", points=points, normals=mixed)
    write_arrays(tmp_path / "poses.npz", {"poses": np.zeros((3, 24, 3))})  # is no scan
    paths = tuple(frame_files(tmp_path))
    assert [path.name for path in paths] == ["0.npz", "1.npz", "2.npz"]
    assert [read_scan(path, 1500, 0, check_normals=True).change for path in paths] == [
        "", "", "pointed to both sides and were turned outward"
    ]  # fmt: skip
    scans = ScanSequence(paths, FileToWorld(1, "y"), 1500, checks_normals=True)
    for index, least in enumerate((1.0, 0.9, 0.9)):
        scan = scans[index]
        true = normals[KDTree(points).query(scan.points)[1]]
        assert ((scan.normals * true).sum(1) > 0).mean() >= least
    assert not any(facts.topology or facts.problem for facts in examine_files(paths))


def test_inside_out_meshes_are_turned(tmp_path):
    vertices, faces = toy_mesh(np.zeros((24, 3)), np.zeros(3))
    trimesh.Trimesh(vertices, faces[:, ::-1], process=False).export(tmp_path / "0.ply")
    scan = ScanSequence((tmp_path / "0.ply",), FileToWorld(1, "y"), 1000)[0]
    assert ((scan.points - vertices.mean(0)) * scan.normals).sum() > 0


def test_a_floor_is_left_out_but_not_everything(tmp_path):
    vertices, faces = toy_mesh(np.zeros((24, 3)), np.zeros(3))
    lowest = vertices[:, 1].min()
    corners = np.array([[-2, lowest, -2], [2, lowest, -2], [2, lowest, 2], [-2, lowest, 2]])
    square = np.array([[0, 2, 1], [0, 3, 2]])
    both = trimesh.util.concatenate([trimesh.Trimesh(vertices, faces, process=False), trimesh.Trimesh(corners, square)])
    both.export(tmp_path / "0.ply")
    trimesh.Trimesh(corners, square).export(tmp_path / "1.ply")
    plane = Floor("y", np.array([0.0, 1, 0]), lowest, 0.01)
    scans = ScanSequence((tmp_path / "0.ply", tmp_path / "1.ply"), FileToWorld(1, "y"), 4000, plane)
    assert scans[0].points[:, 1].min() > lowest + 0.01
    assert len(scans[1]) == 4000  # nobody is in it, which the fit will show


def test_files_that_cannot_be_used_are_told_without_an_error(tmp_path):
    write_scans(tmp_path / "walk", 2, one_topology=True)
    (tmp_path / "walk" / "2.ply").write_bytes(b"ply\nnothing")
    trimesh.PointCloud(floor(0.0)[0][:100]).export(tmp_path / "walk" / "3.ply")
    damaged = trimesh.load_mesh(tmp_path / "walk" / "0.ply", process=False)
    damaged.vertices[5] = np.nan
    damaged.export(tmp_path / "walk" / "4.ply")
    paths = sorted((tmp_path / "walk").iterdir())
    facts = list(examine_files(paths))
    assert [bool(one.problem) for one in facts] == [False, False, True, True, True]
    assert facts[0].topology == facts[1].topology != ""
    assert "NaN" in facts[4].problem


def test_scans_have_changed_if_their_content_or_name_has(tmp_path):
    write_scans(tmp_path / "walk", 2)
    paths = sorted((tmp_path / "walk").iterdir())
    before = fingerprint(paths, list(examine_files(paths)))
    assert fingerprint(paths, list(examine_files(paths))) == before
    moved = [path.rename(path.with_suffix(".PLY")) for path in paths]
    assert fingerprint(moved, list(examine_files(moved))) != before
    first, other = paths = [path.rename(path.with_suffix(".ply")) for path in moved]
    content = first.read_bytes()
    changed = content[:-1] + bytes([content[-1] ^ 1])  # of the same size
    first.write_bytes(changed)
    assert fingerprint(paths, list(examine_files(paths))) != before
    first.write_bytes(content)
    assert fingerprint([first, other], list(examine_files(paths))) == before


def test_points_that_occur_several_times_count_once(tmp_path):
    points = np.random.default_rng(0).random((FEWEST_POINTS, 3))
    np.save(tmp_path / "0.npy", np.repeat(points, 6, axis=0))
    np.save(tmp_path / "1.npy", np.repeat(points[1:], 6, axis=0))
    enough, few = examine_files([tmp_path / "0.npy", tmp_path / "1.npy"])
    assert not enough.problem
    assert f"at least {FEWEST_POINTS} different points, got {FEWEST_POINTS - 1}" in few.problem
