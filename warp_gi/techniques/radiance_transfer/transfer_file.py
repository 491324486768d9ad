"""An example of a reader: exported transfer textures (export.py), read back and evaluated in NumPy."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from warp_gi.errors import BakeError, one_line
from warp_gi.techniques.radiance_transfer.export import DIGEST, FORMAT, FORMAT_VERSION, SIDES
from warp_gi.techniques.radiance_transfer.pca import CHANNELS, expand_bounces
from warp_gi.techniques.radiance_transfer.textures import LIGHT_NUMBERS
from warp_gi.techniques.shared.exr_parts import read_exr_parts


@dataclass(frozen=True, eq=False)
class TransferFile:
    """Exported transfer textures. ``read_export`` reads one."""

    info: dict[str, Any]
    """Contents of the JSON file."""
    images: dict[tuple[int, int, str], np.ndarray]
    """Images by page, side (0 front, 1 back) and kind, float16 or float32 [height, width, channel]."""

    def fetch(self, kind: str, page: int, side: int, uvs: np.ndarray) -> np.ndarray:
        """Return numbers at coordinates of one page, filtered between texels, float32 [point, channel].

        They are 0 where nothing is kept.

        Args:
            kind: "transfer", "bounces" (as they are in the file) or "lamps".
            page: Number of the page.
            side: 0 front, 1 back.
            uvs: TEXCOORD_1, float [point, 2].
        """
        if (page, side, kind) not in self.images:
            channels = next((image.shape[2] for (_, _, name), image in self.images.items() if name == kind), 0)
            return np.zeros((len(uvs), channels), np.float32)
        image, mask = self.images[page, side, kind], self.images[page, side, "mask"][..., 0]
        height, width = mask.shape
        at = np.clip(np.asarray(uvs, np.float64) * (width, height) - 0.5, 0, (width - 1, height - 1))
        low = np.floor(at).astype(int)
        share = at - low
        result, kept = np.zeros((len(uvs), image.shape[2])), np.zeros(len(uvs))
        for dx, wx in ((0, 1 - share[:, 0]), (1, share[:, 0])):
            for dy, wy in ((0, 1 - share[:, 1]), (1, share[:, 1])):
                column, row = np.minimum(low[:, 0] + dx, width - 1), np.minimum(low[:, 1] + dy, height - 1)
                weight = wx * wy * mask[row, column]
                result += weight[:, None] * image[row, column]
                kept += weight
        return (result / np.where(kept > 0, kept, 1)[:, None]).astype(np.float32)

    def irradiance(
        self, pages: np.ndarray, uvs: np.ndarray, light: np.ndarray, sides: np.ndarray | int = 0, terms: str = "TBl"
    ) -> np.ndarray:
        """Return irradiance at coordinates, W/m^2, float32 [point, 3]; a surface reflects albedo / pi of it.

        Args:
            pages: Page of each point, int [point]; -1 is none, where nothing is known: 0.
            uvs: Coordinates in the page, TEXCOORD_1, float [point, 2].
            light: Coefficients of the sky, float [3, 25].
            sides: 0 front, 1 back, of each point.
            terms: "T" directly from the sky, "B" over other surfaces, "l" the scene's lamps over other surfaces.
        """
        pages, sides = np.asarray(pages), np.broadcast_to(sides, np.shape(pages))
        result = np.zeros((len(uvs), 3), np.float32)
        for page, side in {(int(page), int(side)) for page, side in zip(pages, sides, strict=True) if page >= 0}:
            here = (pages == page) & (sides == side)
            result[here] = self._irradiance(page, side, uvs[here], np.asarray(light, np.float32), terms)
        return result

    def _irradiance(self, page: int, side: int, uvs: np.ndarray, light: np.ndarray, terms: str) -> np.ndarray:
        kinds = {name for _, _, name in self.images}
        result = np.zeros((len(uvs), 3), np.float32)
        if "T" in terms:
            result += np.maximum(self.fetch("transfer", page, side, uvs)[:, :LIGHT_NUMBERS] @ light.T, 0)
        if "B" in terms and "bounces" in kinds:
            bounces = self.fetch("bounces", page, side, uvs)
            if components := self.info.get("components"):
                bounces = expand_bounces(np.array(components["basis"]), bounces)
            bounces = bounces.reshape(len(uvs), 3, LIGHT_NUMBERS)
            result += np.maximum(np.einsum("cj,ncj->nc", light, bounces), 0)
        if "l" in terms and "lamps" in kinds:
            result += self.fetch("lamps", page, side, uvs)
        return result

    def shade(
        self, pages: np.ndarray, uvs: np.ndarray, light: np.ndarray, sides: np.ndarray | int = 0, albedo: Any = 1.0
    ) -> np.ndarray:
        """Return the light that a Lambertian surface reflects, W/(m^2 sr), float32 [point, 3].

        ``albedo`` is a number, RGB or float [point, 3]; the others are those of ``irradiance``.
        """
        return (np.asarray(albedo, np.float32) / np.float32(np.pi)) * self.irradiance(pages, uvs, light, sides)


def read_export(path: str | Path) -> TransferFile:
    """Read exported transfer textures by the path of their JSON file, NAME.json, or of NAME.exr.

    Raises BakeError for files that are missing, torn, of another program, of a newer version, or of two exports; and
    for parts and channels that are missing, of another size than the description says, or not finite.
    """
    path = Path(path).with_suffix(".json")
    if not path.is_file():
        raise BakeError(f"{path}: no such file; give the .json file of an export by warp-gi bake --export")
    try:
        info = json.loads(path.read_text())
        is_ours = info["format"] == FORMAT
        version = int(info["version"]) if is_ours else 0
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        is_ours, version = False, 0
    if not is_ours:
        raise BakeError(f"{path}: does not describe {FORMAT}; give the .json file of an export")
    if version > FORMAT_VERSION:
        raise BakeError(
            f"{path}: is of version {version}, this warp_gi reads up to {FORMAT_VERSION}; update it or export again"
        )
    try:
        file = path.parent / _file_name(path, info["file"])
        parts, texts = read_exr_parts(file)
        if texts.get(DIGEST) != info["bake"]:
            raise BakeError(f"{file}: is of another export than {path.name}; export again")
        images = dict(_image(file, parts, part) for part in info["parts"])
        _check_images(info, images)
    except BakeError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, IndexError) as error:
        problem = f"has no {error}" if isinstance(error, KeyError) else one_line(error)
        raise BakeError(f"{path}: does not fit its images ({problem}); export again") from error
    return TransferFile(info, images)


def _file_name(path: Path, name: object) -> str:
    """Return the name of a file beside the description; raises BakeError for one that leads elsewhere."""
    if not isinstance(name, str) or name in ("", ".", "..") or PurePath(name).name != name or "\\" in name:
        raise BakeError(
            f"{path}: its images are said to be in {name!r:.80}, expected the name of a file beside it; export again"
        )
    return name


def _image(
    file: Path, parts: dict[str, dict[str, np.ndarray]], part: dict[str, Any]
) -> tuple[tuple[int, int, str], np.ndarray]:
    """Return page, side and kind of a part of the description, and its image [height, width, channel]."""
    name, channels = part["name"], part["channels"]
    if name not in parts:
        raise BakeError(f"{file}: has no part {name!r:.80}, which its description names; export again")
    missing = [channel for channel in channels if channel not in parts[name]]
    if missing:
        raise BakeError(f"{file}: part {name!r} has no channel {missing[0]!r:.80}; export again")
    image = np.stack([parts[name][channel] for channel in channels], axis=-1)
    return (int(part["page"]), SIDES.index(part["side"]), str(part["kind"])), image


def _check_images(info: dict[str, Any], images: dict[tuple[int, int, str], np.ndarray]) -> None:
    """Raise ValueError unless images have the size of their page, the channels of their kind, and a mask."""
    order, components = int(info["order"]), info.get("components")
    basis = np.array(components["basis"], np.float64) if components else np.zeros((CHANNELS, CHANNELS))
    if basis.ndim != 2 or basis.shape[1] != CHANNELS or not np.isfinite(basis).all():
        raise ValueError(f"the basis of its components is not of {CHANNELS} finite numbers each")
    counts = {"mask": 1, "transfer": order * order, "bounces": len(basis), "lamps": 3}
    sizes = [(int(page["height"]), int(page["width"])) for page in info["pages"]]
    for (page, side, kind), image in images.items():
        name = f"page{page}.{SIDES[side]}.{kind}"
        if not 0 <= page < len(sizes):
            raise ValueError(f"{name} is of none of its {len(sizes)} pages")
        if kind not in counts:
            raise ValueError(f"{name} is of no kind that is known ({', '.join(counts)})")
        wanted = (*sizes[page], counts[kind])
        if image.shape != wanted:
            got, expected = (" x ".join(map(str, (shape[1], shape[0], shape[2]))) for shape in (image.shape, wanted))
            raise ValueError(f"{name} has {got} numbers, expected {expected}: width x height x channels")
        for needed in ("mask", "transfer"):
            if (page, side, needed) not in images:
                raise ValueError(f"there is no part page{page}.{SIDES[side]}.{needed}")
        if not np.isfinite(image).all():
            raise ValueError(f"{name} has numbers that are not finite")
        if kind == "mask" and not ((image == 0) | (image == 1)).all():
            raise ValueError(f"{name} has numbers other than 0 and 1")
