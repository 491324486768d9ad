"""Panels with emission textures over a floor, and the light that they send there by quadrature."""

import numpy as np

import warp_gi as gi

HEIGHT = 1.0
ALBEDO = 0.5


def image(name, size=64):
    """Return values from 0 to 255, uint8 [size, size, 4]."""
    pixels = np.zeros((size, size, 4), np.uint8)
    pixels[..., 3] = 255
    if name == "texel":
        pixels[size // 3, size // 2, :3] = 255
    elif name == "checkered":
        pixels[..., :3] = 255 * (np.indices((size, size)).sum(axis=0) // (size // 8) % 2)[..., None]
    elif name == "gradient":
        pixels[..., :3] = np.linspace(0, 255, size)[None, :, None]
    elif name == "sparse":
        lit = np.random.default_rng(1).integers(0, size, (40, 2))
        pixels[lit[:, 0], lit[:, 1], :3] = np.random.default_rng(2).integers(50, 256, (40, 3))
    return pixels


def panel(pixels, uv=1.0, colors=None, second_set=False, emission=1.0, **how):
    """Return a square of 1 m that shines down from HEIGHT; ``pixels`` None is even."""
    points = np.array([[-0.5, HEIGHT, -0.5], [0.5, HEIGHT, -0.5], [0.5, HEIGHT, 0.5], [-0.5, HEIGHT, 0.5]], np.float32)
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32) * uv
    texture = None if pixels is None else gi.Texture("sign", pixels, srgb=False, uv_set=int(second_set), **how)
    shines = gi.Material(
        "sign",
        (0, 0, 0),
        specular=0.0,
        emission=(emission,) * 3,
        emission_texture=texture,
        colors_emit=colors is not None,
        double_sided=False,
    )
    further = uvs if second_set else None
    return gi.Mesh(
        points, np.array([[0, 1, 2], [0, 2, 3]]), shines, uvs=0 * uvs if second_set else uvs,
        further_uvs=further, colors=colors,
    )  # fmt: skip


def floor(size=3.0):
    points = np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], np.float32) * size
    grey = gi.Material("floor", (ALBEDO,) * 3, specular=0.0)
    return gi.Mesh(points, np.array([[0, 1, 2], [0, 2, 3]]), grey)


def looks(texture, u, v):
    """Return what a texture shows at places, [..., 3], by its definition: row 0 at the top, v up."""
    pixels = texture.pixels[::-1, :, :3].astype(np.float64) / 255
    size = pixels.shape[0]

    def fold(x, mode):
        if mode == "clamp":
            return np.clip(x, 0, 1)
        return x % 1 if mode == "repeat" else 1 - np.abs(x % 2 - 1)

    def index(i, mode):
        return i % size if mode == "repeat" else np.clip(i, 0, size - 1)

    x, y = fold(u, texture.wrap[0]) * size, fold(v, texture.wrap[1]) * size
    if texture.nearest:
        return pixels[index(np.floor(y).astype(int), texture.wrap[1]), index(np.floor(x).astype(int), texture.wrap[0])]
    total = 0.0
    for row in (0, 1):
        for column in (0, 1):
            i, j = np.floor(x - 0.5).astype(int) + column, np.floor(y - 0.5).astype(int) + row
            weight = (1 - np.abs(x - 0.5 - i)) * (1 - np.abs(y - 0.5 - j))
            total = total + weight[..., None] * pixels[index(j, texture.wrap[1]), index(i, texture.wrap[0])]
    return total


def reflected(mesh, places=1280):
    """Return what the floor below the panel's middle reflects, [3], by quadrature in ``places``^2 points."""
    at = (np.arange(places) + 0.5) / places
    s, t = np.meshgrid(at, at)  # along x and z
    corners = mesh.uvs if mesh.further_uvs is None else mesh.further_uvs
    uv = [corners[0, k] + s * (corners[1, k] - corners[0, k]) + t * (corners[3, k] - corners[0, k]) for k in (0, 1)]
    texture = mesh.material.emission_texture
    if texture.transform is not None:
        rows = np.asarray(texture.transform)
        uv = [row[0] * uv[0] + row[1] * uv[1] + row[2] for row in rows]
    light = looks(texture, *uv) * mesh.material.emission
    if mesh.colors is not None:  # linear on each of the two triangles, which share the corners 0 and 2
        c = mesh.colors.astype(np.float64)[:, None, None, :3]
        s3, t3 = s[..., None], t[..., None]
        light = light * np.where(s3 > t3, c[0] * (1 - s3) + c[1] * (s3 - t3) + c[2] * t3,
                                 c[0] * (1 - t3) + c[2] * s3 + c[3] * (t3 - s3))  # fmt: skip
    square = (s - 0.5) ** 2 + (t - 0.5) ** 2 + HEIGHT**2
    return ALBEDO / np.pi * (light * (HEIGHT**2 / square**2)[..., None]).mean(axis=(0, 1))


def view(mesh, pipeline, seed=0):
    """Return radiance of 256 pixels that look at the point below the panel's middle, [16, 16, 3].

    A lamp below the floor lights nothing, and makes lights that are to be chosen from.
    """
    hidden = gi.PunctualLight("point", (1e-3, 1e-3, 1e-3), position=(0, -5, 0))
    scene = gi.Scene([gi.Node("floor", [floor()]), gi.Node("panel", [mesh])], lights=[hidden])
    camera = gi.Camera.look_at((0, 0.5, 0.001), (0, 0, 0), hfov=0.01, resolution=(16, 16))
    return next(iter(gi.render(scene, camera, pipeline, seed=seed))).numpy("beauty").astype(np.float64)
