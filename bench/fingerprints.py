"""Hashes of pictures, to see that a change of the code changes none: ``python -m warp_gi.bench.fingerprints FILE``.

Renders ten frames of every preset, and of estimators and denoisers that no preset has, in four built-in scenes along
their camera paths, and compares a hash of every buffer with FILE; without that file, writes it. Equal hashes mean
pictures that are equal to the last bit, on the same machine and the same version of Warp.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import warp_gi as gi
from warp_gi.errors import OptionError
from warp_gi.files import replacing

SCENES = ("cornell_box", "two_rooms", "warehouse", "atrium")
APART = "probe_view"  # the preset that shows a bake, without its scene
FRAMES = range(10)
RESOLUTION = (48, 32)
SAMPLES = 4


def pipelines() -> dict[str, gi.Pipeline]:
    """Return the pipelines that are rendered, by name."""
    small: dict[str, Any] = {"spp": SAMPLES}
    found = {name: gi.Pipeline.preset(name, **small) for name in gi.Pipeline.presets() if name != APART}
    hierarchy, uniform = gi.LightHierarchy(), gi.UniformLights()
    field = gi.VisibilityField(mode="unbiased", cell_size=0.4)
    relit = gi.VisibilityField(sky="harmonics", relight=True, cell_size=0.4)
    found["hierarchy"] = gi.Pipeline(emitters=hierarchy, indirect=None, **small)
    found["uniform"] = gi.Pipeline(emitters=uniform, **small)
    found["unbiased field"] = gi.Pipeline(environment=field, emitters=None, indirect=None, **small)
    found["relight"] = gi.Pipeline(environment=relit, emitters=None, indirect=None, **small)
    found["paper field"] = gi.Pipeline(environment=gi.VisibilityField(mode="paper", sky="harmonics"), **small)
    found["path, spatiotemporal"] = gi.Pipeline.preset("path", denoise="spatiotemporal", **small)
    found["probes, spatiotemporal"] = gi.Pipeline.preset("probes", denoise="spatiotemporal", **small)
    found["cache alone"] = gi.Pipeline(environment=None, emitters=gi.VisibilityLightCache(), indirect=None, **small)
    found["guided alone"] = gi.Pipeline(environment=None, emitters=None, indirect=gi.GuidedPaths(), **small)
    hybrid = gi.LightFieldProbes(mode="hybrid")
    found["hybrid probes"] = gi.Pipeline(indirect=hybrid, filter="tent", **small)
    return found


def fingerprints(device: str) -> Iterator[tuple[str, list[str]]]:
    """Yield "scene: pipeline" and the hashes of its frames."""
    for scene_name in SCENES:
        for name, pipeline in pipelines().items():
            scene = gi.builtin_scene(scene_name)
            path = gi.builtin_camera_path(scene_name).at_resolution(*RESOLUTION)
            frames = gi.render(scene, path, pipeline, FRAMES, device, seed=3)
            yield f"{scene_name}: {name}", [hashed(frame) for frame in frames]
        if scene_name == "cornell_box":
            bake = gi.bake(scene, gi.LightFieldProbes(), device, 3, path)
            frames = gi.render(bake, path, gi.Pipeline.preset(APART, spp=SAMPLES), FRAMES, device, seed=3)
            yield f"{scene_name}: probe_view", [hashed(frame) for frame in frames]


def hashed(frame: gi.Frame) -> str:
    """Return a hash of all buffers of a frame."""
    digest = hashlib.sha256()
    for name in frame.names:
        digest.update(name.encode())
        digest.update(frame.numpy(name).tobytes())
    return digest.hexdigest()[:16]


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare hashes with those in a file, or write the file; return 1 if any differ."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("file", type=Path, help="hashes, JSON; written if it is not there")
    parser.add_argument("--device", default="cpu", help="cpu, cuda or cuda:1")
    options = parser.parse_args(arguments)
    known = json.loads(options.file.read_text()) if options.file.exists() else None
    found: dict[str, list[str]] = {}
    wrong = 0
    started = time.process_time()
    for name, hashes in fingerprints(options.device):
        found[name] = hashes
        if known is None:
            print(f"{name}: {len(hashes)} frames, {time.process_time() - started:.1f} s", flush=True)
        elif name not in known:
            raise OptionError(f"{options.file} lacks {name!r}; delete it and write it anew")
        else:
            different = [index for index, (a, b) in enumerate(zip(known[name], hashes, strict=True)) if a != b]
            wrong += bool(different)
            print(f"{name}: {'differs in frames ' + str(different) if different else 'equal'}", flush=True)
    if known is None:
        with replacing(options.file) as path:
            path.write_text(json.dumps(found, indent=1))
        return 0
    print(f"{len(found) - wrong} of {len(found)} equal")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
