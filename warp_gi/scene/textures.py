"""Images and materials as the kernels read them: one buffer of texels, one table each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warp_gi.color import BAND, SRGB_TO_LINEAR
from warp_gi.errors import SceneError
from warp_gi.kernels import types
from warp_gi.scene.model import Material, Texture

WRAPS = {"repeat": types.WRAP_REPEAT, "clamp": types.WRAP_CLAMP, "mirror": types.WRAP_MIRROR}

TEXTURE_SLOTS = (
    "base_color_texture",
    "metallic_roughness_texture",
    "normal_texture",
    "emission_texture",
    "specular_texture",
    "reflectance_texture",
    "transmission_texture",
)


NUMBERS = (
    "base_color",
    "alpha",
    "metallic",
    "roughness",
    "specular",
    "reflectance",
    "normal_scale",
    "emission",
    "transmission",
)


def check_texture(texture: Texture, owner: str) -> None:
    """Raise SceneError unless ``texture`` has pixels, uint8 [height, width, 4], and known wrap modes."""
    pixels, name = texture.pixels, f"{owner}, texture {texture.name!r}"
    shape = getattr(pixels, "shape", None)
    if shape is None or len(shape) != 3 or shape[2] != 4 or pixels.dtype != np.uint8:
        raise SceneError(
            f"{name}: expected uint8 pixels [height, width, 4], got {getattr(pixels, 'dtype', '')} {shape}"
        )
    if 0 in shape:
        raise SceneError(f"{name}: expected at least 1x1 pixels, got {shape[1]}x{shape[0]}")
    for wrap in texture.wrap:
        if wrap not in WRAPS:
            raise SceneError(f"{name}: unknown wrap mode {wrap!r} (known: {', '.join(WRAPS)})")
    if texture.uv_set not in (0, 1):
        raise SceneError(f"{name}: uv_set must be 0 or 1, got {texture.uv_set!r}")
    if texture.transform is not None:
        rows = np.asarray(texture.transform, np.float64)
        if rows.shape != (2, 3) or not np.isfinite(rows).all():
            raise SceneError(f"{name}: transform must be two rows of 3 finite numbers, got {texture.transform!r}")


def check_material(material: Material) -> None:
    """Raise SceneError where a field of ``material`` is out of its range or not finite."""
    owner = f"material {material.name!r}"

    def within(label: str, values: object, low: float, high: float) -> None:
        plain = values if isinstance(values, tuple) else (values,)
        if all(type(value) is float and low <= value <= high for value in plain):
            return  # without NumPy, which takes five times as long for one number
        array = np.asarray(values, np.float64)
        if not np.all((array >= low) & (array <= high)):
            raise SceneError(f"{owner}: {label} must be from {low:g} to {high:g}, got {values}")

    for label, size in (("base_color", 3), ("emission", 3), ("reflectance", 3)):
        if np.shape(getattr(material, label)) != (size,):
            raise SceneError(f"{owner}: {label} must be {size} numbers, got {getattr(material, label)!r}")
    for label in ("base_color", "alpha", "metallic", "roughness", "specular", "transmission"):
        within(label, getattr(material, label), 0.0, 1.0)
    within("emission", material.emission, 0.0, 1e30)
    within("reflectance", material.reflectance, 0.0, 1e6)
    within("normal_scale", material.normal_scale, -1e6, 1e6)
    if material.alpha_cutoff is not None:
        within("alpha_cutoff", material.alpha_cutoff, 0.0, np.inf)
        if material.alpha_blend:
            raise SceneError(f"{owner}: has an alpha_cutoff and alpha_blend, which are two readings of alpha; keep one")
    for slot in TEXTURE_SLOTS:
        texture = getattr(material, slot)
        if texture is not None:
            check_texture(texture, owner)
    base = material.base_color_texture
    if base is not None and (base.uv_set or base.transform is not None):
        raise SceneError(f"{owner}: a base_color_texture takes uv_set 0 and no transform; transform the mesh's uvs")


def distinct_textures(materials: Sequence[Material]) -> list[Texture]:
    """Return the textures of ``materials``, each once, in order of first use."""
    found = {id(t): t for m in materials for t in (getattr(m, slot) for slot in TEXTURE_SLOTS) if t is not None}
    return list(found.values())


def texture_table(textures: Sequence[Texture], with_texels: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return the table (dtype of types.Texture) and the texels (uint32, red in the low byte, bottom row first).

    Textures that share one array of pixels share their texels. Without texels there are none, [0]. Raises SceneError
    past 2**31 texels.
    """
    images = list({id(texture.pixels): texture.pixels for texture in textures}.values())
    sizes = [image.shape[0] * image.shape[1] for image in images]
    if sum(sizes) >= 2**31:
        raise SceneError(f"textures hold {sum(sizes)} texels, more than 2^31; scale them down")
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    texels = np.empty(max(int(starts[-1]), 1) if with_texels else 0, np.uint32)
    texels[starts[-1] :] = 0
    start_of = {}
    for image, start, size in zip(images, starts, sizes, strict=False):
        start_of[id(image)] = start
        if with_texels:
            texels[start : start + size].view(np.uint8).reshape(image.shape)[:] = image[::-1]
    table = np.zeros(len(textures), types.Texture.numpy_dtype())
    for index, texture in enumerate(textures):
        height, width = texture.pixels.shape[:2]
        wrap_u, wrap_v = (WRAPS[wrap] for wrap in texture.wrap)
        rows = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)) if texture.transform is None else texture.transform
        moved = texture.uv_set != 0 or texture.transform is not None
        how = int(texture.srgb), int(texture.nearest), texture.uv_set, int(moved)
        table[index] = (start_of[id(texture.pixels)], width, height, wrap_u, wrap_v, *how, *rows)
    return table, texels


def material_table(materials: Sequence[Material], textures: Sequence[Texture]) -> np.ndarray:
    """Return the materials as an array with the dtype of types.Material; textures by their index in ``textures``."""
    index_of = {id(texture): index for index, texture in enumerate(textures)}
    table = np.zeros(len(materials), types.Material.numpy_dtype())
    for row, material in zip(table, materials, strict=True):
        for label in NUMBERS:
            row[label] = getattr(material, label)
        row["alpha_cutoff"] = -1.0 if material.alpha_cutoff is None else material.alpha_cutoff
        row["alpha_blend"] = int(material.alpha_blend)
        row["double_sided"] = int(material.double_sided)
        row["colors_emit"] = int(material.colors_emit)
        for slot in TEXTURE_SLOTS:
            texture = getattr(material, slot)
            row[slot] = -1 if texture is None else index_of[id(texture)]
    return table


def visibility_parts(material: Material) -> list[np.ndarray | str]:
    """Return all of a material that decides which rays pass through its triangles, for a hash."""
    texture = material.base_color_texture
    by_alpha = material.alpha_blend or material.alpha_cutoff is not None
    cutoff = -1.0 if material.alpha_cutoff is None else material.alpha_cutoff
    parts: list[np.ndarray | str] = [np.array([material.alpha, cutoff])] if by_alpha else []
    if by_alpha and texture is not None:
        parts += [repr((texture.wrap, texture.nearest)), texture.pixels[..., 3]]
    if material.is_glass:
        numbers = [material.transmission, material.mean_metallic, material.specular]
        parts += ["glass", np.array([*numbers, *material.reflectance, *material.base_color])]
        if texture is not None:
            parts += [repr((texture.wrap, texture.nearest, texture.srgb)), texture.pixels]
        share = material.transmission_texture
        if share is not None:
            parts += [repr((share.wrap, share.nearest, share.uv_set, share.transform)), share.pixels[..., 0]]
    return parts


def texture_coordinates(texture: Texture, uvs: np.ndarray, further_uvs: np.ndarray | None) -> np.ndarray:
    """Return where a texture is looked up at vertices with these two sets of coordinates [..., 2]."""
    if texture.uv_set:
        uvs = np.zeros_like(uvs) if further_uvs is None else further_uvs
    if texture.transform is None:
        return uvs
    rows = np.asarray(texture.transform, np.float64)
    return uvs @ rows[:, :2].T + rows[:, 2]


def linear_shades(texture: Texture) -> np.ndarray:
    """Return the linear values of 8-bit red, green and blue, float32 [256]."""
    return SRGB_TO_LINEAR if texture.srgb else np.arange(256, dtype=np.float32) / 255.0


def linear_rgb(texture: Texture) -> np.ndarray:
    """Return float32 [height, width, 3], linear, row 0 at the top."""
    rgb = texture.pixels[..., :3]
    return SRGB_TO_LINEAR[rgb] if texture.srgb else rgb.astype(np.float32) / 255.0


def box_means(
    image: np.ndarray, wrap: tuple[str, str], low: np.ndarray, high: np.ndarray, shades: np.ndarray | None = None
) -> np.ndarray:
    """Return the means of the texels that bilinear lookups in uv boxes can read, float64 [n, channel].

    ``image`` is [height, width, channel] with values from 0 to 1, row 0 at the top; or uint8, of which ``shades`` [256]
    are the values. ``low`` and ``high`` are the corners of the boxes, [n, 2], v up. One texel around is counted in.
    Sums are exact integers (steps of 2^-24, rounded up), so a mean is zero only where every
    lookup gives zero. They take the memory of some rows, however large the image.
    """
    ranges = []
    for axis, mode in ((1, wrap[0]), (0, wrap[1])):
        texels = image.shape[axis]
        size = 2 * texels if mode == "mirror" else texels
        begin = np.floor(low[:, 1 - axis].astype(np.float64) * texels - 0.5) - 1.0
        end = np.floor(high[:, 1 - axis].astype(np.float64) * texels - 0.5) + 3.0
        if mode == "clamp":
            begin, end = np.clip(begin, 0, size - 1), np.clip(end, 1, size)
        else:
            whole, wrapped = end - begin >= size, np.mod(begin, size)
            begin, end = np.where(whole, 0, wrapped), np.where(whole, size, wrapped + end - begin)
        ranges.append((begin.astype(np.int64), end.astype(np.int64)))
    size = tuple(image.shape[axis] * (2 if wrap[1 - axis] == "mirror" else 1) for axis in (0, 1))
    (left, right), (bottom, top) = ranges
    rows, row = np.divmod(np.stack([top, bottom, bottom, top]), size[0])  # the image is repeated once
    columns, column = np.divmod(np.stack([right, left, right, left]), size[1])
    ends = [np.full_like(row, end) for end in size]
    asked = np.stack([row, ends[0], row, ends[0]]), np.stack([column, column, ends[1], ends[1]])
    sums = _prefix_sums(image, wrap, shades, asked[0].ravel(), asked[1].ravel()).reshape(4, 4, len(low), -1)
    whole = np.stack([np.ones_like(rows), rows, columns, rows * columns])[..., None]
    below = (whole * sums).sum(axis=0)
    total = below[0] + below[1] - below[2] - below[3]
    return total / (2.0**24 * (right - left) * (top - bottom))[:, None]


def _prefix_sums(
    image: np.ndarray, wrap: tuple[str, str], shades: np.ndarray | None, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """Return sums of steps of 2^-24 over all rows (from the bottom) and columns before these, int64 [n, channel]."""
    height = image.shape[0]
    steps = None if shades is None else _steps(np.asarray(shades))
    order = np.argsort(rows, kind="stable")
    starts = np.flatnonzero(np.diff(rows[order], prepend=-1))
    result = np.empty((len(rows), image.shape[2]), np.int64)
    total, done = np.int64(0), 0
    most = max(BAND // image.shape[1], 1)
    for start, stop in zip(starts, [*starts[1:], len(order)], strict=True):
        row = int(rows[order[start]])
        while done < row:
            some = np.arange(done, min(done + most, row))
            band = image[height - 1 - np.where(some < height, some, 2 * height - 1 - some)]
            total = total + (_steps(band) if steps is None else steps[band]).sum(axis=0)
            done += len(some)
        line = np.zeros((image.shape[1], image.shape[2]), np.int64) + total
        if wrap[0] == "mirror":
            line = np.concatenate([line, line[::-1]])
        before = np.concatenate([np.zeros((1, image.shape[2]), np.int64), line.cumsum(axis=0)])
        result[order[start:stop]] = before[columns[order[start:stop]]]
    return result


def _steps(values: np.ndarray) -> np.ndarray:
    """Return values from 0 to 1 in steps of 2^-24, rounded up, int64."""
    return np.ceil(values.astype(np.float64) * 2.0**24).astype(np.int64)
