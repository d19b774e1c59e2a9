from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from snarfcli.meshing.mesh import Mesh
from snarfcli.rendering.camera import Camera
from snarfcli.rendering.floor import Backdrop, Floor
from snarfcli.rendering.lighting import Look, Solid
from snarfcli.rendering.render import render


def ball(center=(0.0, 0.5, 0.0), radius=0.5, colors=None) -> Mesh:
    solid = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    colors = None if colors is None else np.tile(np.uint8(colors), (len(solid.vertices), 1))
    return Mesh(solid.vertices + center, solid.faces, colors=colors)


RED = (220, 30, 30)


def redness(picture: np.ndarray) -> np.ndarray:
    color = picture.astype(int)
    return color[..., 0] - (color[..., 1] + color[..., 2]) // 2 > 40


def test_a_ball_is_drawn_where_it_is_projected():
    mesh = ball(colors=RED)
    camera = Camera.framing(mesh.vertices)
    picture = render(mesh, camera, (160, 120))
    assert picture.shape == (120, 160, 3)
    assert picture.dtype == np.uint8
    rows, columns = np.nonzero(redness(picture))
    pixels = camera.project(mesh.vertices, 160, 120)
    np.testing.assert_allclose([columns.min(), columns.max() + 1], [pixels[:, 0].min(), pixels[:, 0].max()], atol=1.5)
    np.testing.assert_allclose([rows.min(), rows.max() + 1], [pixels[:, 1].min(), pixels[:, 1].max()], atol=1.5)


def test_light_comes_from_above_and_the_floor_is_shaded():
    mesh = ball(colors=(180, 180, 180))
    camera = Camera.framing(mesh.vertices, margin=0.25)
    picture = render(mesh, camera, 200, floor_y=0.0).astype(float).mean(axis=2)
    center = camera.project(np.array([[0.0, 0.5, 0.0]]), 200, 200)[0]
    top, bottom = (camera.project(np.array([[0.0, y, 0.0]]), 200, 200)[0] for y in (0.9, 0.1))
    assert picture[int(top[1]), int(top[0])] > picture[int(bottom[1]), int(bottom[0])] + 20
    # contact shadow: beside the foot of the ball the floor is darker than on the empty stage
    empty = render(None, camera, 200, floor_y=0.0).astype(float).mean(axis=2)
    foot = camera.project(np.array([[0.25, 0.0, 0.35]]), 200, 200)[0]
    assert picture[int(foot[1]), int(foot[0])] < empty[int(foot[1]), int(foot[0])] - 10
    assert center[2] == pytest.approx(np.linalg.norm(np.subtract(camera.position, (0, 0.5, 0))), rel=0.01)


def test_supersampling_comes_nearer_to_a_large_picture_made_small():
    camera = Camera.framing(ball().vertices)
    large = render(ball(colors=RED), camera, 512, supersample=1).reshape(64, 8, 64, 8, 3).mean(axis=(1, 3))
    edge = np.abs(np.diff(redness(large), axis=1)).any(axis=1)
    errors = [np.abs(render(ball(colors=RED), camera, 64, supersample=s)[edge] - large[edge]).mean() for s in (1, 3)]
    assert errors[1] < 0.7 * errors[0]


def test_pictures_are_repeatable_and_do_not_depend_on_where_the_world_is():
    camera = Camera.framing(ball().vertices)
    picture = render(ball(), camera, 64)
    np.testing.assert_array_equal(picture, render(ball(), camera, 64))
    shift = np.array([16.0, 0.0, -8.0])
    moved = Camera(tuple(camera.position + shift), tuple(camera.target + shift), camera.fov_rad)
    far = render(ball(center=(16.0, 0.5, -8.0)), moved, 64)
    assert np.abs(far.astype(int) - picture).mean() < 1  # float32 of 16 m: a shadow ray may fall on the other side


def test_framing_keeps_every_point_inside_and_fills_the_picture():
    rng = np.random.default_rng(0)
    for aspect, size in ((1.0, (100, 100)), (16 / 9, (160, 90)), (0.5, (50, 100))):
        points = rng.standard_normal((50, 3)) * (2.0, 1.0, 0.5) + (3, 1, -2)
        camera = Camera.framing(points, aspect=aspect, margin=0.05, azimuth_rad=rng.uniform(0, 6))
        pixels = camera.project(points, *size)[:, :2] / size
        assert pixels.min() > 0.045
        assert pixels.max() < 0.955
        assert max(np.ptp(pixels, axis=0)) > 0.85


def test_views_straight_down_and_from_inside_work():
    camera = Camera.framing(ball().vertices, elevation_rad=math.pi / 2)
    assert np.isfinite(camera.axes).all()
    assert render(ball(), camera, 32).shape == (32, 32, 3)
    assert render(ball(), Camera((0.0, 0.5, 0.0), (1.0, 0.5, 0.0)), 32).std() < 60
    assert render(Mesh(np.zeros((0, 3)), np.zeros((0, 3))), camera, 32).shape == (32, 32, 3)


def test_wrong_arguments_are_named():
    camera = Camera.framing(ball().vertices)
    with pytest.raises(ValueError, match="size: wanted positive numbers"):
        render(ball(), camera, 0)
    with pytest.raises(ValueError, match="points: wanted at least one finite point"):
        Camera.framing(np.zeros((0, 3)))
    with pytest.raises(ValueError, match="camera: wanted different points as position and target"):
        render(ball(), Camera((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), 32)


def test_a_prepared_backdrop_gives_the_same_picture():
    mesh, other = ball(), ball(center=(0.3, 0.6, 0.1))
    camera = Camera.framing(mesh.vertices, margin=0.2)
    backdrop = Backdrop(camera, (64, 48), Floor(-0.1), Look())
    for shown in (mesh, other, None):
        wanted = render(shown, camera, (64, 48), floor_y=-0.1)
        np.testing.assert_array_equal(render(shown, camera, (64, 48), backdrop=backdrop), wanted)
    np.testing.assert_array_equal(
        render(Solid(mesh), camera, (64, 48), backdrop=backdrop), render(mesh, camera, (64, 48), floor_y=-0.1)
    )
    for size, floor_y in ((64, None), ((64, 48), 0.0)):
        with pytest.raises(ValueError, match="backdrop: wanted one for this camera, size and look"):
            render(mesh, camera, size, floor_y=floor_y, backdrop=backdrop)


def test_lines_on_the_floor_are_faint_and_stay_where_they_are():
    camera = Camera.framing(ball().vertices, elevation_rad=math.radians(60), margin=0.3)
    plain, lined = (
        render(None, camera, 160, backdrop=Backdrop(camera, (160, 160), Floor(0.0, spacing), Look())).astype(int)
        for spacing in (None, 0.25)
    )
    darker = (plain - lined).mean(axis=2)
    assert darker.min() >= 0
    assert 1 < darker.max() < 25
    assert 0.01 < (darker > 1).mean() < 0.2
    # lines lie at multiples of the spacing in world coordinates, for any camera
    for x in (0.25, -0.5):
        column, row, _ = camera.project(np.array([[x, 0.0, 0.125]]), 160, 160)[0]
        around = darker[int(row), int(column) - 1 : int(column) + 2]
        assert around.max() > 1
