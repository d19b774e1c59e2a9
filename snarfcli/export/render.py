"""Pictures of meshes by ray casting with Embree: no display, no OpenGL.

DESIGN. Primary rays are cast only inside the mesh's box on the screen, `supersample` squared a pixel. Light comes from a sky
dome and a large key light, both tested for occlusion with a few rays a pixel; neighbouring pixels turn the same
directions differently and a small blur joins them, so that 12 rays look like a hundred. The floor is an analytic plane
whose shadow is computed on a coarse grid around the mesh. 512 x 512 takes a quarter of a second of one core.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter

from snarfcli.export.camera import Camera
from snarfcli.export.lighting import PATTERN, LitScene, Look, dot
from snarfcli.meshing.mesh import Mesh

__all__ = ["Look", "render"]

_LOOK = Look()
_FLOOR_CELLS = 128  # floor shadow grid, each way: 2 to 3 cm for a standing body


def render(
    mesh: Mesh | None,
    camera: Camera,
    size: int | tuple[int, int] = 512,
    *,
    floor_y: float | None = None,
    supersample: int = 2,
    look: Look = _LOOK,
) -> np.ndarray:
    """Draw a mesh on a plain floor.

    Args:
        mesh: its colours are used as albedo if it has any; None draws the empty stage.
        camera: where from.
        size: pixels, (width, height) or one number for both.
        floor_y: height of the floor, metres; the lowest vertex by default.
        supersample: rays along each side of a pixel.
        look: colours and lights.

    Returns:
        [height, width, 3] uint8, sRGB.

    Raises:
        ValueError: size or supersample is not positive.
    """
    width, height = (size, size) if isinstance(size, int) else size
    if width < 1 or height < 1 or supersample < 1:
        raise ValueError(f"size: wanted positive numbers, got {width} x {height} pixels of {supersample} rays a side")
    if mesh is not None and not len(mesh.faces):
        mesh = None
    if floor_y is None:
        floor_y = float(mesh.vertices[:, 1].min()) if mesh is not None else 0.0
    scene = None if mesh is None else LitScene(mesh, camera, floor_y, look)
    picture = _floor_and_backdrop(scene, camera, width, height, floor_y, look).reshape(-1, 3)
    if scene is not None:
        pixel, color = _draw(scene, width, height, supersample)
        share = 1 / supersample**2
        cover = np.bincount(pixel, minlength=len(picture)) * share
        added = np.stack([np.bincount(pixel, color[:, i], minlength=len(picture)) for i in range(3)], axis=1) * share
        picture = picture * (1 - cover[:, None]) + added
    return _to_srgb(picture).reshape(height, width, 3)


def _draw(scene: LitScene, width: int, height: int, supersample: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixel [M] that each ray which hits belongs to and the colour [M, 3] it sees, linear."""
    camera, mesh = scene.camera, scene.mesh
    low, high = _screen_box(scene, width, height)
    columns = np.arange(low[0] * supersample, high[0] * supersample)
    rows = np.arange(low[1] * supersample, high[1] * supersample)
    sample_x, sample_y = (grid.ravel() for grid in np.meshgrid(columns, rows))
    if not sample_x.size:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    view = camera.rays((sample_x + 0.5) / supersample, (sample_y + 0.5) / supersample, width, height)
    hits = scene.first_hits(np.asarray(camera.position), view)
    seen = hits["primID"] >= 0
    sample_x, sample_y, view = sample_x[seen], sample_y[seen], view[seen]
    corner = mesh.faces[hits["primID"][seen]]
    u, v = hits["u"][seen, None], hits["v"][seen, None]
    share = np.concatenate([1 - u - v, u, v], axis=1).astype(np.float32)

    def blend(attribute: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", share, attribute[corner])

    points, normals = blend(mesh.vertices), blend(scene.normals)
    normals /= np.sqrt(np.maximum(dot(normals, normals), 1e-12))
    # Inner sides of open meshes, and smooth normals that look away at the silhouette.
    normals = np.where(dot(normals, view) > 0.25, -normals, normals)
    albedo = np.asarray(scene.look.body, dtype=np.float32) if mesh.colors is None else blend(from_srgb(mesh.colors))

    # Light is gathered once a pixel and spread to its other samples.
    pixel_x, pixel_y = sample_x // supersample - low[0], sample_y // supersample - low[1]
    box = (high[1] - low[1], high[0] - low[0])
    flat = pixel_y * box[1] + pixel_x
    first = np.unique(flat, return_index=True)[1]
    phase = (pixel_y[first] % PATTERN) * PATTERN + pixel_x[first] % PATTERN
    light = np.zeros((box[0] * box[1], 4), dtype=np.float32)
    light[flat[first], :3], light[flat[first], 3] = scene.gather(points[first], normals[first], phase, floor=True)
    known = np.zeros(box, dtype=np.float32)
    known.reshape(-1)[flat[first]] = 1
    light = light.reshape(*box, 4)
    weight = np.maximum(uniform_filter(known, PATTERN, mode="constant"), 1e-6)
    smooth = np.stack([uniform_filter(light[..., i], PATTERN, mode="constant") / weight for i in range(4)], axis=-1)
    light = smooth.reshape(-1, 4)[flat]
    color = _shade(scene, normals, view, albedo, light[:, :3], light[:, 3:])
    return (pixel_y + low[1]) * width + pixel_x + low[0], color


def _shade(
    scene: LitScene, normals: np.ndarray, view: np.ndarray, albedo: np.ndarray, dome: np.ndarray, key_seen: np.ndarray
) -> np.ndarray:
    """Return the colour of surface points [M, 3]: diffuse dome and key, a rim light, a broad soft highlight."""
    facing = np.maximum(-dot(normals, view), 0)
    # Wrapped a little around the terminator, as skin and clay do.
    key = np.maximum((normals @ scene.key)[:, None] + 0.12, 0) / 1.12
    half = scene.key - view
    half /= np.sqrt(dot(half, half))
    gloss = np.maximum(dot(normals, half), 0) ** 2
    gloss = (gloss * gloss * gloss) ** 4  # to the 24th
    fresnel = (1 - facing) ** 3
    rim = np.maximum((normals @ scene.rim)[:, None], 0) * (0.15 + fresnel)
    key_color, rim_color = (np.asarray(color, dtype=np.float32) for color in (scene.look.key, scene.look.rim))
    lit = albedo * (dome + key_seen * key * key_color + rim * rim_color)
    return lit + 0.05 * gloss * key_seen * key_color + 0.10 * fresnel * dome


def _screen_box(scene: LitScene, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (lower, upper) around the projected mesh; all of them if it reaches behind the camera."""
    pixels = scene.camera.project(scene.mesh.vertices, width, height)
    limit = np.array([width, height])
    if (pixels[:, 2] <= 1e-3).any():
        return np.zeros(2, dtype=int), limit
    low = np.floor(pixels[:, :2].min(axis=0) - 1).clip(0, limit).astype(int)
    return low, np.ceil(pixels[:, :2].max(axis=0) + 1).clip(low, limit).astype(int)


def _floor_and_backdrop(
    scene: LitScene | None, camera: Camera, width: int, height: int, floor_y: float, look: Look
) -> np.ndarray:
    """Return the empty stage [height, width, 3], linear, with the shadow of the scene on the floor."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5))
    view = camera.rays(x, y, width, height)
    backdrop = np.asarray(look.backdrop) * (1.02 - 0.10 * (y / height)[:, None])
    above = camera.position[1] - floor_y
    down = -view[:, 1]
    meets = (down > 1e-4) & (above > 0)
    distance = np.where(meets, above / np.where(meets, down, 1), 1e9)
    ground = np.asarray(camera.position)[[0, 2]] + view[:, [0, 2]] * distance[:, None]
    light = np.ones(len(ground), dtype=np.float32)
    if scene is not None:
        shadow, low, cell = _floor_shadow(scene)
        spot = (ground - low) / cell - 0.5
        light = map_coordinates(shadow, spot.T, order=1, mode="nearest")
    # A pool of light that fades into the backdrop, so that no horizon shows.
    reach = np.linalg.norm(np.subtract(camera.position, camera.target))
    away = np.linalg.norm(ground - np.asarray(camera.target)[[0, 2]], axis=1) / reach
    fade = np.clip((away - 0.12) / 0.75, 0, 1)
    fade = np.where(meets, fade * fade * (3 - 2 * fade), 1)[:, None]
    floor = np.asarray(look.floor) * light[:, None]
    return (floor * (1 - fade) + backdrop * fade * (1 - (1 - light[:, None]) * (1 - fade))).reshape(height, width, 3)


def _floor_shadow(scene: LitScene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the light on the floor around the mesh: a grid [X, Z] of shares, its lower corner and cell size, metres."""
    low, high = scene.mesh.bounds
    tall = max(float(high[1]) - scene.floor_y, 0.05)
    thrown = -scene.key[[0, 2]] / scene.key[1] * tall
    corners = np.stack([low[[0, 2]], high[[0, 2]], low[[0, 2]] + thrown, high[[0, 2]] + thrown])
    margin = 0.45 * tall
    lower, upper = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    cell = (upper - lower) / _FLOOR_CELLS
    index = np.stack(np.meshgrid(np.arange(_FLOOR_CELLS), np.arange(_FLOOR_CELLS), indexing="ij"), axis=-1).reshape(-1, 2)
    spots = lower + (index + 0.5) * cell
    points = np.stack([spots[:, 0], np.full(len(spots), scene.floor_y), spots[:, 1]], axis=1)
    normals = np.broadcast_to((0.0, 1.0, 0.0), points.shape)
    phase = (index[:, 0] % PATTERN) * PATTERN + index[:, 1] % PATTERN
    dome, key = scene.gather(points, normals, phase, floor=False)
    grid = np.stack([dome.mean(axis=1), key]).reshape(2, _FLOOR_CELLS, _FLOOR_CELLS)
    grid = np.stack([gaussian_filter(uniform_filter(g, PATTERN, mode="nearest"), 0.9) for g in grid])
    dome = np.minimum(grid[0] / np.percentile(grid[0], 90), 1)  # the farthest tenth counts as open
    light = 0.58 * dome**1.6 + 0.42 * grid[1]
    # The border of the grid must be unshaded, or its edge would show on the floor.
    edge = np.minimum(np.arange(_FLOOR_CELLS), np.arange(_FLOOR_CELLS)[::-1]) / (0.2 * _FLOOR_CELLS)
    inner = np.minimum(np.minimum.outer(edge, edge), 1)
    return 1 - (1 - light) * inner * inner * (3 - 2 * inner), lower, cell


def from_srgb(color: np.ndarray) -> np.ndarray:
    """Return linear colour of sRGB bytes."""
    share = color.astype(np.float32) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def _to_srgb(color: np.ndarray) -> np.ndarray:
    """Return sRGB bytes of linear colour; highlights above 0.8 roll off instead of clipping."""
    knee = 0.8
    over = np.maximum(color - knee, 0)
    color = np.where(color > knee, knee + (1 - knee) * (1 - np.exp(-over / (1 - knee))), np.maximum(color, 0))
    srgb = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
    return np.rint(255 * srgb.clip(0, 1)).astype(np.uint8)
