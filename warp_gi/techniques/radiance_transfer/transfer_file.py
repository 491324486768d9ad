"""An example of a reader: exported transfer textures (export.py), read back and evaluated in NumPy."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warp_gi.errors import BakeError
from warp_gi.techniques.radiance_transfer.export import DIGEST, FORMAT, FORMAT_VERSION, SIDES
from warp_gi.techniques.radiance_transfer.pca import expand_bounces
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

    Raises BakeError for files that are missing, torn, of another program, of a newer version, or of two exports.
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
        file, wanted = path.parent / info["file"], info["parts"]
        parts, texts = read_exr_parts(file)
        if texts.get(DIGEST) != info["bake"]:
            raise BakeError(f"{file}: is of another export than {path.name}; export again")
        images = {
            (int(part["page"]), SIDES.index(part["side"]), str(part["kind"])): np.stack(
                [parts[part["name"]][channel] for channel in part["channels"]], axis=-1
            )
            for part in wanted
        }
    except BakeError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BakeError(f"{path}: does not fit its images ({error}); export again") from error
    return TransferFile(info, images)
