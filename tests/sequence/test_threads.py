"""Threads and schedulers that share one scene: each frame and bake is what it would be alone, to the last bit."""

from __future__ import annotations

import itertools
import sys
import threading
import time

import numpy as np
import pytest
from concurrency_tools import (
    FIELD,
    FPS,
    buffers,
    differing,
    frames,
    main,
    moving_room,
    pipeline,
    run_case,
    scheduler,
    still_path,
)

import warp_gi as gi
from warp_gi import launch, workers
from warp_gi.techniques.reuse.pictures import reuse_pictures


def together(*works):
    """Return what functions return that run at once, each on a thread of its own; raises what one raises."""
    results, errors = [None] * len(works), []

    def run(i):
        try:
            results[i] = works[i]()
        except BaseException as error:
            errors.append(error)

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)  # seconds; threads take turns often
    try:
        threads = [threading.Thread(target=run, args=(i,)) for i in range(len(works))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(before)
    if errors:
        raise errors[0]
    return results


# ---- cases: each runs in a process of its own ----


def two_threads_one_scene(preset):
    """Two threads render other times of one scene with other seeds."""
    parts = [(range(12), 1), (range(4, 16), 2)]
    wanted = [frames(moving_room(), indices, preset, seed) for indices, seed in parts]
    scene = moving_room()
    works = [lambda part=part: frames(scene, part[0], preset, part[1]) for part in parts]
    for found, right in zip(together(*works), wanted, strict=True):
        assert differing(found, right) == []


def bake_beside_frames():
    """A bake sees the scene at time 0, whenever it is made, and leaves frames alone."""
    wanted, camera = frames(moving_room(), range(20)), still_path(moving_room())
    right = gi.bake(moving_room(), FIELD, camera_path=camera).digest
    scene = moving_room()

    def bakes():
        return [gi.bake(scene, FIELD, camera_path=camera).digest for _ in range(3)]

    found, digests = together(lambda: frames(scene, range(20)), bakes)
    assert differing(found, wanted) == []
    assert digests == [right] * 3


def edits_beside_frames():
    """A new sky waits for the frame that another thread renders: each frame has the old one or the new one."""
    skies = [(0.1, 0.2, 0.4), (2.0, 1.0, 0.5)]
    wanted = []
    for sky in skies:
        scene = moving_room()
        scene.environment = sky
        wanted.append([frame["beauty"].tobytes() for frame in frames(scene, range(4))])
    renderer, ends = scheduler(scene), threading.Event()

    def edit():
        while not ends.is_set():
            for sky in skies:
                scene.environment = sky
                time.sleep(0.001)

    def render():
        try:
            return [renderer.frame(index % 4).numpy("beauty").tobytes() for index in range(24)]
        finally:
            ends.set()

    found, _ = together(render, edit)
    for number, picture in enumerate(found):
        assert picture in [pictures[number % 4] for pictures in wanted], number


def other_thread_counts_beside_launches():
    """``set_threads`` may be called while several threads launch."""
    wanted, left = frames(moving_room(), range(8)), [2]

    def change():
        while left[0]:
            for count in (2, 3, 5, 4):
                launch.set_threads(count)

    def render():
        try:
            scene = moving_room()
            return [frames(scene, range(8)) for _ in range(2)]
        finally:
            left[0] -= 1

    for found in itertools.chain(*together(render, render, change)[:2]):
        assert differing(found, wanted) == []


# ---- tests ----


@pytest.mark.parametrize("preset", ["path", "dvf", "reuse"])
def test_two_threads_on_one_scene(preset):
    run_case(__file__, "two_threads_one_scene", preset)


@pytest.mark.parametrize("case", ["bake_beside_frames", "edits_beside_frames", "other_thread_counts_beside_launches"])
def test_threads(case):
    run_case(__file__, case)


@pytest.mark.parametrize("preset", ["path", "dvf", "reuse"])
def test_two_schedulers_in_turns(preset):
    """In one thread, frame by frame, towards other times: motion vectors and the tree are each one's own."""
    parts = [(range(4), 1), ((6, 5, 4, 3), 2)]
    scene = moving_room()
    renders = [gi.render(scene, still_path(scene), pipeline(preset), indices, seed=seed) for indices, seed in parts]
    kept = list(zip(*renders, strict=True))  # looked at when all are rendered: a frame's buffers are its own
    for number, found in enumerate(zip(*kept, strict=True)):
        renderer = scheduler(moving_room(), preset, parts[number][1])
        right = [buffers(renderer.frame(b, a)) for a, b in itertools.pairwise([None, *parts[number][0]])]
        assert differing([buffers(frame) for frame in found], right) == []
        assert any(np.abs(frame["motion"]).max() > 0.1 for frame in right)


def test_a_bake_does_not_depend_on_who_moved_the_scene():
    camera = still_path(moving_room())
    right = gi.bake(moving_room(), FIELD, camera_path=camera)
    scene = moving_room()
    scene.update(1.5, 0.5, "cpu")
    assert gi.bake(scene, FIELD, camera_path=camera).digest == right.digest
    scene.update(1.5, 0.5, "cpu")
    assert scheduler(scene, "dvf").state("environment").to_bake().digest == (
        scheduler(moving_room(), "dvf").state("environment").to_bake().digest
    )


def test_pictures_of_reuse_are_of_their_frame(tmp_path):
    """Wherever others have moved the scene since."""
    scene = moving_room()
    renderer = scheduler(scene, "reuse")
    frame = [renderer.frame(index) for index in range(FPS)][-1]
    first = [path.read_bytes() for path in reuse_pictures(renderer, frame, tmp_path)]
    scene.update(0.0, 0.0, "cpu")
    assert [path.read_bytes() for path in reuse_pictures(renderer, frame, tmp_path)] == first


def test_an_exception_frees_the_scene():
    scene = moving_room()

    def fail(stage, share):
        if stage == "trace":
            raise ValueError(stage)

    with pytest.raises(ValueError, match="trace"):
        scheduler(scene, progress=fail).frame(1)
    assert together(lambda: scene.lock.acquire(timeout=10)) == [True]


def test_frames_wait_while_the_lock_is_held():
    """Whoever moves the scene and reads it holds its lock meanwhile."""
    scene = moving_room()
    renderer, began = scheduler(scene), threading.Event()
    renderer.frame(0)

    def render():
        began.set()
        renderer.frame(FPS)

    thread = threading.Thread(target=render)
    with scene.lock:
        scene.update(0.25, 0.25, "cpu")
        points = scene.data("cpu").geometry.points
        before = points.numpy().copy()
        thread.start()
        began.wait()
        thread.join(0.3)
        assert thread.is_alive() and np.array_equal(points.numpy(), before)
    thread.join()
    assert not np.array_equal(points.numpy(), before)
    assert not workers._open


def test_a_bake_looks_for_edits_when_it_has_the_scene():
    """What another thread edits while it holds the lock, and undoes, is none."""
    scene = moving_room()
    scene.data("cpu")
    points, found = scene.nodes[0].meshes[0].points, []
    thread = threading.Thread(target=lambda: found.append(gi.bake(scene, FIELD, camera_path=still_path(scene))))
    with scene.lock:
        points[0, 0] += 1.0
        thread.start()
        thread.join(0.3)
        assert thread.is_alive()
        points[0, 0] -= 1.0
    thread.join()
    assert len(found) == 1


if __name__ == "__main__":
    launch.set_threads(2)
    main(two_threads_one_scene, bake_beside_frames, edits_beside_frames, other_thread_counts_beside_launches)
