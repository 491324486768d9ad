"""Make the reference pictures of the tests with Mitsuba 3: ``python -m warp_gi.bench.mitsuba_reference [NAME...]``.

Each becomes tests/reference/NAME.exr with the mean (R, G, B) and the variance of that
mean (variance.R, ...) over independent renderings, whose number it keeps as "renderings".
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.stages import LAMBERT, PLAIN, Case
from warp_gi.bench.peers.mitsuba_peer import load_mitsuba, to_mitsuba
from warp_gi.errors import unknown_name
from warp_gi.sequence.exr import write_exr

FOLDER = Path(__file__).resolve().parents[1] / "tests" / "truth" / "reference"
SIZE = (72, 40)
"""Width and height of the pictures."""


@dataclass(frozen=True)
class Picture(Case):
    """A place as both renderers get it: the materials Mitsuba has an equal for, flat normals, one-sided emission."""

    max_depth: int = 4
    """Number of edges of the longest path from camera to light: 2 is direct light."""
    peer_error: float = 0.0
    """Relative standard error of Mitsuba's picture that comes from its ray offset: rays start 9e-5 (1 + |x|) m
    off a surface at x and look past what is thinner, such as paint. With that offset here the difference is gone."""

    def camera(self) -> gi.Camera:
        """Return the camera at the pictures' size."""
        return super().camera().at_resolution(*SIZE)


PICTURES: dict[str, Picture] = {
    "cornell_box": Picture("cornell_box", materials=LAMBERT, max_depth=6),
    "sponza_white_sky": Picture("sponza", materials=LAMBERT),
    "sponza_courtyard": Picture("sponza_courtyard", materials=LAMBERT),
    "living_room_lamp": Picture("living_room", materials=LAMBERT, max_depth=5, peer_error=0.003),
    "spheres_lamp": Picture("spheres", materials=PLAIN, max_depth=5),
    "spheres_interior": Picture("spheres_interior", materials=PLAIN, max_depth=5),
    "lamp_wall": Picture("lamp_wall", materials=PLAIN),
    "white_room": Picture("white_room", materials=LAMBERT, max_depth=5),
}
"""Pictures by the names of their files."""


def integrator(max_depth: int, masks: bool) -> Any:
    """Return Mitsuba's path tracer without Russian roulette; the volumetric one if light passes through masks.

    Mitsuba's ``path`` takes masks for opaque to shadow rays and counts them as vertices.
    """
    kind = "volpath" if masks else "path"
    return load_mitsuba().load_dict({"type": kind, "max_depth": max_depth, "rr_depth": 1000})


def reference(name: str, renderings: int, spp: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance of the mean, float64 [height, width, 3]."""
    mi, picture = load_mitsuba(), PICTURES[name]
    scene = picture.scene()
    masks = any(material.lets_rays_pass for material in scene.materials)
    peer, paths = to_mitsuba(scene, picture.camera()), integrator(picture.max_depth, masks)
    rendered = [np.array(mi.render(peer, integrator=paths, spp=spp, seed=1000 + i)) for i in range(renderings)]
    images = np.stack(rendered).astype(np.float64)
    return images.mean(axis=0), images.var(axis=0, ddof=1) / renderings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help=f"default: all of {', '.join(PICTURES)}")
    parser.add_argument("--renderings", type=int, default=64)
    parser.add_argument("--spp", type=int, default=256, help="samples a pixel of each rendering")
    parser.add_argument("--output", type=Path, default=FOLDER)
    options = parser.parse_args()
    for name in options.names or PICTURES:
        if name not in PICTURES:
            raise unknown_name("reference", name, PICTURES)
        if PICTURES[name].missing:
            print(f"{name}: skipped, {PICTURES[name].missing}")
            continue
        started = time.perf_counter()
        mean, variance = reference(name, options.renderings, options.spp)
        attributes = {
            "renderer": f"Mitsuba {load_mitsuba().__version__}",
            "renderings": options.renderings,
            "samples": options.spp,
            "maxDepth": PICTURES[name].max_depth,
            "software": f"warp_gi {gi.__version__} bench",
        }
        options.output.mkdir(parents=True, exist_ok=True)
        write_exr(options.output / f"{name}.exr", {"beauty": mean, "variance": variance}, attributes, precision="float")
        noise = np.sqrt(variance.mean()) / mean.mean()
        seconds = time.perf_counter() - started
        print(f"{name}: mean {mean.mean():.5f}, noise of a pixel {noise:.3%}, {seconds:.0f} s", flush=True)


if __name__ == "__main__":
    main()
