"""Pictures of meshes by ray casting: no display, no OpenGL.

DESIGN. Primary rays are cast only inside the bounding box of the mesh on the screen, `supersample` squared per pixel. Light
comes from a sky dome and a large key light, both tested for occlusion with a few rays per pixel; neighbouring pixels use
different directions and a small blur averages them, so that 12 rays look like a hundred. Constant parts are kept from picture
to picture: a `Solid` serves several cameras, a `Backdrop` all pictures of a fixed camera. A body at 512 x 512 takes a fifth of
a second of one core with Embree (benchmarks/bm_video.py), and four times as long without it.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter

from snarfcli.meshing.colors import from_srgb
from snarfcli.meshing.mesh import Mesh
from snarfcli.rendering.camera import Camera
from snarfcli.rendering.floor import Backdrop, Floor
from snarfcli.rendering.lighting import PATTERN, LitScene, Look, Solid, dot

__all__ = ["Look", "render"]

_LOOK = Look()
_KNEE = 0.8  # linear colour above which highlights are compressed instead of clipped
_BRIGHTEST = 4.0  # linear colour above which the 8-bit colour is constant


def render(
    mesh: Mesh | Solid | None,
    camera: Camera,
    size: int | tuple[int, int] = 512,
    *,
    floor_y: float | None = None,
    supersample: int = 2,
    look: Look = _LOOK,
    backdrop: Backdrop | None = None,
) -> np.ndarray:
    """Draw a mesh on a plain floor.

    Args:
        mesh: its colours, if any, are the albedo; None draws the empty stage. A `Solid` is faster for several pictures.
        camera: position and view.
        size: pixels, (width, height) or one number for both.
        floor_y: height of the floor, metres; the lowest vertex by default.
        supersample: number of rays along each side of a pixel.
        look: colours and lights.
        backdrop: prepared background for this camera, size and look; it has its own floor.

    Returns:
        [height, width, 3] uint8, sRGB.

    Raises:
        ValueError: size or supersample is not positive, or the backdrop is for another picture.
    """
    width, height = (size, size) if isinstance(size, int) else size
    if width < 1 or height < 1 or supersample < 1:
        raise ValueError(f"size: wanted positive numbers, got {width} x {height} pixels and supersample={supersample}")
    if isinstance(mesh, Mesh):
        mesh = Solid(mesh) if len(mesh.faces) else None
    if backdrop is None:
        if floor_y is None:
            floor_y = float(mesh.mesh.vertices[:, 1].min()) if mesh is not None else 0.0
        backdrop = Backdrop(camera, (width, height), Floor(floor_y), look)
    elif (backdrop.camera, backdrop.size, backdrop.look) != (camera, (width, height), look) or floor_y is not None:
        raise ValueError("backdrop: wanted one for this camera, size and look, and no floor_y, got another one or floor_y")
    scene = None if mesh is None else LitScene(mesh, camera, backdrop.floor.height, look)
    picture = backdrop.picture(scene)
    if scene is not None:
        pixel, color = _draw(scene, width, height, supersample)
        share = 1 / supersample**2
        cover = np.bincount(pixel, minlength=len(picture))
        drawn = np.flatnonzero(cover)
        added = np.stack([np.bincount(pixel, color[:, i], minlength=len(picture))[drawn] for i in range(3)], axis=1)
        picture[drawn] = picture[drawn] * (1 - share * cover[drawn, None]) + share * added
    return _to_srgb(picture).reshape(height, width, 3)


def _draw(scene: LitScene, width: int, height: int, supersample: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixel [M] and the linear colour [M, 3] of each ray that hits the mesh."""
    camera, solid = scene.camera, scene.solid
    mesh = solid.mesh
    low, high = _screen_box(scene, width, height)
    columns = np.arange(low[0] * supersample, high[0] * supersample)
    rows = np.arange(low[1] * supersample, high[1] * supersample)
    if not (len(columns) and len(rows)):
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    view = camera.rays((columns + 0.5) / supersample, (rows + 0.5) / supersample, width, height)
    hits = solid.first_hits(np.asarray(camera.position), view)
    seen = np.flatnonzero(hits.triangle >= 0)
    sample_x, sample_y, view = columns[seen % len(columns)], rows[seen // len(columns)], view[seen]
    corner = mesh.faces[hits.triangle[seen]]
    u, v = hits.u[seen, None], hits.v[seen, None]
    share = np.concatenate([1 - u - v, u, v], axis=1).astype(np.float32)

    def blend(attribute: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", share, attribute[corner])

    points, normals = blend(mesh.vertices), blend(solid.normals)
    normals /= np.sqrt(np.maximum(dot(normals, normals), 1e-12))
    # Flip normals on inner sides of open meshes; smooth normals may point slightly away at the silhouette.
    normals = np.where(dot(normals, view) > 0.25, -normals, normals)
    albedo = np.asarray(scene.look.body, dtype=np.float32) if mesh.colors is None else blend(from_srgb(mesh.colors))

    # Light is gathered once per pixel and used for all its samples.
    pixel_x, pixel_y = sample_x // supersample - low[0], sample_y // supersample - low[1]
    box = (high[1] - low[1], high[0] - low[0])
    flat = pixel_y * box[1] + pixel_x
    first = np.full(box[0] * box[1], -1)
    first[flat[::-1]] = np.arange(len(flat))[::-1]
    first = first[first >= 0]
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
    # Light wraps a little around the terminator, as on skin and clay.
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
    pixels = scene.camera.project(scene.solid.mesh.vertices, width, height)
    limit = np.array([width, height])
    if (pixels[:, 2] <= 1e-3).any():
        return np.zeros(2, dtype=int), limit
    low = np.floor(pixels[:, :2].min(axis=0) - 1).clip(0, limit).astype(int)
    return low, np.ceil(pixels[:, :2].max(axis=0) + 1).clip(low, limit).astype(int)


def _to_srgb(color: np.ndarray) -> np.ndarray:
    """Return linear colour as sRGB bytes; highlights are compressed instead of clipped."""
    return _SRGB[(color.clip(0, _BRIGHTEST) * ((len(_SRGB) - 1) / _BRIGHTEST) + 0.5).astype(np.intp)]


def _srgb_table(count: int = 2**16) -> np.ndarray:
    """Return the sRGB bytes [count] of linear colours from 0 to the brightest; 2^16 resolve all but the darkest bytes."""
    color = np.linspace(0, _BRIGHTEST, count)
    over = np.maximum(color - _KNEE, 0)
    color = np.where(color > _KNEE, _KNEE + (1 - _KNEE) * (1 - np.exp(-over / (1 - _KNEE))), color)
    srgb = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
    return np.rint(255 * srgb).astype(np.uint8)


_SRGB = _srgb_table()
