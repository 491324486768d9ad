"""Files of every format that the library reads, changed at random: none crashes, hangs, grows, faults or gives NaN."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from campaign_tools import HERE, Worker, forge, mutated, record, size_of

pytestmark = pytest.mark.slow
BAD = ("fault", "nan", "crash", "hang", "memory")
KINDS = {".glb": "scene", ".gltf": "scene", ".obj": "scene", ".ply": "scene", ".stl": "scene", ".off": "scene"}


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    """Files to change, each with what it is read as."""
    folder = tmp_path_factory.mktemp("seeds")
    from PIL import Image

    from warp_gi.sequence.exr import write_exr

    rng = np.random.default_rng(0)
    found = [
        (path, KINDS[path.suffix]) for path in sorted(HERE.parent.joinpath("cases").rglob("*")) if path.suffix in KINDS
    ]
    (folder / "a.off").write_text("OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n")
    (folder / "a.stl").write_text(
        "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n"
        "endfacet\nendsolid a\n"
    )
    (folder / "b.stl").write_bytes(
        bytes(80) + (1).to_bytes(4, "little") + rng.random(12).astype("<f4").tobytes() + bytes(2)
    )
    Image.fromarray(rng.integers(0, 256, (8, 16, 3)).astype(np.uint8)).save(folder / "a.png")
    write_exr(
        folder / "a.exr",
        {"beauty": rng.random((8, 16, 3)), "depth": rng.random((8, 16))},
        {"name": "x", "warp_gi/seed": 1},
    )
    import OpenImageIO as oiio

    assert oiio.ImageBuf(rng.random((8, 16, 3)).astype(np.float32)).write(str(folder / "a.hdr"))
    keys = [{"time": t, "eye": [0, 1, 3 - t], "target": [0, 1, 0], "hfov": 50} for t in (0, 0.5, 1)]
    (folder / "a.json").write_text(json.dumps({"fps": 24, "keyframes": keys, "resolution": [8, 6]}))
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()} for _ in range(2)]
    (folder / "b.json").write_text(json.dumps({"camera_angle_x": 0.8, "w": 8, "h": 6, "frames": frames}))
    subprocess.run(
        [sys.executable, HERE / "campaign_worker.py", folder], check=True, timeout=600, stdout=subprocess.DEVNULL
    )
    named = {
        "a.png": ["image", "sky"],
        "a.exr": ["image", "sky"],
        "a.hdr": ["image", "sky"],
        "a.json": ["camera"],
        "b.json": ["camera"],
    }
    named |= {"a.off": ["scene"], "a.stl": ["scene"], "b.stl": ["scene"]}
    named |= {path.name: ["bake"] for path in folder.glob("*.bake.safetensors")}
    named |= {path.name: [f"state-{path.name.split('.')[0]}"] for path in folder.glob("*.state.safetensors")}
    found += [(folder / name, kind) for name, kinds in named.items() for kind in kinds]
    libraries = sorted(HERE.parent.joinpath("cases").rglob("*.mtl"))
    return found + [(path, "library") for path in libraries]


def test_mutated_files(seeds, tmp_path, pytestconfig):
    count, chance = size_of("mutations", 300), random.Random(size_of("seed", 1))
    by_suffix: dict[str, list[tuple[Path, str]]] = {}
    for path, kind in seeds:
        by_suffix.setdefault(f"{path.suffix} {kind}" + f" {path.stem}" * (kind == "bake"), []).append((path, kind))
    worker, counts, bad = Worker(), Counter(), []
    for path, kind in seeds:  # unchanged, they are read: what is found later is not an old fault
        if kind != "library":
            outcome = worker.ask(kind, path)["outcome"]
            assert outcome in ("fine", "refused"), (path, outcome)
    worker.is_warm = True
    try:
        for number in range(count):
            path, kind = chance.choice(by_suffix[chance.choice(sorted(by_suffix))])
            made = tmp_path / f"{number}{path.suffix}"
            if path.suffix == ".safetensors" and chance.random() < 0.8:
                forge(path, made, chance)
            else:
                made.write_bytes(mutated(path.read_bytes(), path.suffix, chance))
            asked = made
            if kind == "library":
                asked, kind = tmp_path / f"{number}.obj", "scene"
                names = [
                    line.split()[1]
                    for line in path.read_text(errors="replace").splitlines()
                    if line.strip().startswith("newmtl")
                ]
                faces = "".join(f"usemtl {name}\nf 1/1 2/1 3/1\n" for name in names)
                asked.write_text(f"mtllib {made.name}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n{faces}f 1 2 3\n")
            answer = worker.ask(kind, asked)
            worker.is_warm = worker.process is not None
            counts[str(answer["outcome"])] += 1
            if answer["outcome"] in BAD:
                bad.append(f"{kind} {asked}: {answer['outcome']} {answer['told']}")
            else:
                made.unlink()
    finally:
        worker.close()
    record("mutated files", count, counts, f"{len(by_suffix)} kinds of files")
    assert not bad, "\n".join(bad)
