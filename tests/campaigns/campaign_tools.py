"""What campaigns share: their sizes, a mutator of files, a worker that may die, and the page of counts."""

from __future__ import annotations

import itertools
import json
import os
import queue
import random
import resource
import signal
import struct
import subprocess
import sys
import threading
import time
import traceback
from collections import Counter
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
COUNTS = HERE / "counts.json"
PAGE = HERE.parents[1] / "docs" / "reference" / "campaigns.md"
HANG, MOST_BYTES = 30.0, 4e9
EXTREMES = ["nan", "inf", "-1", "0", "1e39", "-1e308", "1e-45", "4294967296", "9" * 40, "", "x", "1/0", "-0"]
VALUES = [None, -1, 0, 1e308, -1e308, 1e-300, "x", "", [], {}, 2**31, 2**63, 10**40, True, [[]], "data:,"]


def size_of(name: str, default: int) -> int:
    """Return the size of a campaign: an environment variable WARP_GI_CAMPAIGN_NAME, or the default."""
    return int(os.environ.get(f"WARP_GI_CAMPAIGN_{name.upper()}", default))


# ---- mutations ----


def mutated(data: bytes, suffix: str, chance: random.Random) -> bytes:
    """Return a file's bytes, changed in one to three ways that suit its kind."""
    for _ in range(chance.randint(1, 3)):
        ways = [flipped, cut, repeated, moved, zeroed]
        if suffix in (".obj", ".mtl", ".ply", ".off", ".hdr", ".stl"):
            ways += [number_changed, number_changed, line_changed, line_changed]
        if suffix in (".gltf", ".json"):
            ways = [flipped, cut, json_changed, json_changed, json_changed, json_changed]
        if suffix == ".glb":
            ways += [glb_changed] * 6
        if suffix in (".exr", ".safetensors", ".png"):
            ways += [header_flipped] * 4
        data = chance.choice(ways)(data, chance)
    return data


def flipped(data: bytes, chance: random.Random, most: int | None = None) -> bytes:
    changed = bytearray(data)
    for _ in range(chance.randint(1, 8)):
        if changed:
            changed[chance.randrange(min(len(changed), most or len(changed)))] = chance.choice(
                [0, 255, 128, 127, chance.randrange(256)]
            )
    return bytes(changed)


def header_flipped(data: bytes, chance: random.Random) -> bytes:
    return flipped(data, chance, 700)


def cut(data: bytes, chance: random.Random) -> bytes:
    return data[: chance.randrange(len(data) + 1)]


def repeated(data: bytes, chance: random.Random) -> bytes:
    start, stop = sorted(chance.randrange(len(data) + 1) for _ in range(2))
    return data[:stop] + data[start:stop][:10_000] + data[stop:]


def moved(data: bytes, chance: random.Random) -> bytes:
    start, stop = sorted(chance.randrange(len(data) + 1) for _ in range(2))
    rest, at = data[:start] + data[stop:], chance.randrange(len(data) + 1)
    return rest[:at] + data[start:stop] + rest[at:]


def zeroed(data: bytes, chance: random.Random) -> bytes:
    start = chance.randrange(len(data) + 1)
    count = chance.choice([1, 2, 4, 8, 100])
    return data[:start] + bytes([chance.choice([0, 255])]) * count + data[start + count :]


def number_changed(data: bytes, chance: random.Random) -> bytes:
    words = data.split(b" ")
    places = [i for i, word in enumerate(words) if word[:1] in b"0123456789-+." and word]
    if places:
        words[chance.choice(places)] = chance.choice(EXTREMES).encode()
    return b" ".join(words)


def line_changed(data: bytes, chance: random.Random) -> bytes:
    lines = data.split(b"\n")
    one, other = chance.randrange(len(lines)), chance.randrange(len(lines))
    way = chance.randrange(4)
    if way == 0:
        lines[one], lines[other] = lines[other], lines[one]
    elif way == 1:
        lines.insert(one, lines[other] * chance.choice([1, 2, 50]))
    elif way == 2:
        del lines[one]
    else:
        words = lines[one].split()
        lines[one] = b" ".join(words[: chance.randint(0, len(words))] * chance.choice([1, 1, 30]))
    return b"\n".join(lines)


def json_changed(data: bytes, chance: random.Random) -> bytes:
    try:
        root = json.loads(data)
    except (ValueError, RecursionError):
        return flipped(data, chance)
    places = []
    pending = [root]
    while pending:
        one = pending.pop()
        for key in list(one) if isinstance(one, dict) else range(len(one)):
            places.append((one, key))
            if isinstance(one[key], dict | list):
                pending.append(one[key])
    if not places:
        return flipped(data, chance)
    owner, key = chance.choice(places)
    way = chance.randrange(5)
    if way == 0:
        del owner[key]
    elif way == 1 and isinstance(owner[key], int | float) and not isinstance(owner[key], bool):
        owner[key] = chance.choice([owner[key] + 1, owner[key] - 1, -owner[key], owner[key] * 1000, owner[key] + 0.5])
    elif way == 2:
        other, name = chance.choice(places)
        owner[key] = json.loads(
            json.dumps(other.get(name) if isinstance(other, dict) else (other[name : name + 1] or [0])[0])
        )
    else:
        owner[key] = chance.choice(VALUES)
    return json.dumps(root).encode()


def glb_changed(data: bytes, chance: random.Random) -> bytes:
    if len(data) < 20 or data[:4] != b"glTF":
        return flipped(data, chance)
    (length,) = struct.unpack("<I", data[12:16])
    text = json_changed(data[20 : 20 + length].rstrip(b" \0"), chance)
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return (
        b"glTF"
        + struct.pack("<II", 2, 20 + len(text) + len(rest))
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + rest
    )


def forge(path: Path, target: Path, chance: random.Random) -> None:
    """Write a bake or state with arrays or settings changed, and the seal of who knows how."""
    sys.path.insert(0, str(HERE.parent))
    from test_forged_states import forged, mutations

    import warp_gi as gi

    bake = gi.load_bake(path)
    rng = np.random.default_rng(chance.getrandbits(32))
    for name, _, arrays in itertools.islice(mutations(bake.arrays, rng), chance.choice([1, 1, 2])):
        bake = forged(bake, bake.arrays | {name: arrays[name]})
    for values in (bake.settings, bake.counts):
        if values and chance.random() < 0.2:
            values[chance.choice(sorted(values))] = chance.choice([0, -1, 1e30, 10**9, 0.5, 2**40])
    with np.errstate(all="ignore"):
        bake.save(target)


# ---- a worker ----


class Worker:
    """A process that reads files; another one takes its place when it has died, hung or grown."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[str] | None = None
        self.answers: queue.Queue[str] = queue.Queue()
        self.is_warm = False

    def ask(self, kind: str, path: Path) -> dict[str, object]:
        """Return what became of a file: outcome is fine, refused, fault, nan, crash, hang or memory."""
        process = self.process
        if process is None:
            process = self.process = self._started()
        assert process.stdin is not None
        try:
            process.stdin.write(f"{kind} {path}\n")
            process.stdin.flush()
            line = self.answers.get(timeout=HANG if self.is_warm else 10 * HANG)  # the first compiles kernels
        except queue.Empty:
            self.close()
            return {"outcome": "hang", "told": ""}
        except BrokenPipeError:
            line = ""
        if not line:
            code = process.wait()
            self.close()
            return {"outcome": "crash", "told": f"exit code {code}"}
        answer: dict[str, object] = json.loads(line)
        if float(str(answer["peak"])) > MOST_BYTES:
            answer["outcome"] = "memory"
            self.close()
        return answer

    def _started(self) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, str(HERE / "campaign_worker.py")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=os.environ | {"WARP_GI_THREADS": "1"},
        )
        self.answers, self.is_warm = queue.Queue(), False
        answers = self.answers

        def listen() -> None:
            assert process.stdout is not None
            for line in process.stdout:
                if line.startswith("\x01"):
                    answers.put(line[1:])
            answers.put("")

        threading.Thread(target=listen, daemon=True).start()
        return process

    def close(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None


# ---- commands in forks ----


class Command:
    """A command of warp-gi in a fork of this process, where modules and kernels are loaded: it may be killed.

    Args:
        arguments: Those of the command.
        most_bytes: No file may become larger (RLIMIT_FSIZE), as on a disk that is full; None is no limit.
        bakes: Folder in which bakes are kept, however short they took; None is the user's, with ``--no-cache`` none.
    """

    def __init__(self, arguments: list[str], most_bytes: int | None = None, bakes: Path | None = None) -> None:
        self._said, said = os.pipe()
        sys.stdout.flush()
        self.process = os.fork()
        if self.process == 0:
            code = 70
            try:
                os.close(self._said)
                for number in (1, 2):
                    os.dup2(said, number)
                sys.stdout, sys.stderr = (open(number, "w", closefd=False) for number in (1, 2))
                code = self._run(arguments, most_bytes, bakes)
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stderr.flush()
                os._exit(code)
        os.close(said)
        self.code: int | None = None
        self.said = ""

    @staticmethod
    def _run(arguments: list[str], most_bytes: int | None, bakes: Path | None) -> int:
        from warp_gi import kept
        from warp_gi.cli import main

        if bakes is not None:
            os.environ["WARP_GI_BAKES"], kept.LEAST_SECONDS = str(bakes), 0.0
        if most_bytes is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
        return main.main(arguments)

    def wait(self, seconds: float = 90.0) -> int | None:
        """Return the exit code, below 0 for a signal; None if it runs on after some seconds."""
        until = time.monotonic() + seconds
        while self.code is None:
            process, status = os.waitpid(self.process, os.WNOHANG)
            if process:
                self.code = os.waitstatus_to_exitcode(status)
                with open(self._said, encoding="utf-8", errors="replace") as pipe:
                    self.said = pipe.read()
            elif time.monotonic() > until:
                return None
            else:
                time.sleep(0.002)
        return self.code

    def kill(self) -> None:
        """Kill it (SIGKILL), and wait for that."""
        os.kill(self.process, signal.SIGKILL)
        self.wait()


def run(arguments: list[str], **more: Any) -> Command:
    """Run a command to its end."""
    command = Command(arguments, **more)
    if command.wait() is None:
        command.kill()
    return command


# ---- counts ----


def record(campaign: str, size: int, counts: Counter[str], note: str = "") -> None:
    """Keep the counts of a campaign, and write the page of them, if WARP_GI_CAMPAIGN_PAGE is set.

    WARP_GI_CAMPAIGN_ADD adds them to what is there, for campaigns that are run in parts with several seeds.
    """
    print(f"{campaign}: {size} {dict(counts)} {note}")
    if not os.environ.get("WARP_GI_CAMPAIGN_PAGE"):
        return
    known = json.loads(COUNTS.read_text()) if COUNTS.is_file() else {}
    if os.environ.get("WARP_GI_CAMPAIGN_ADD") and campaign in known:
        size, counts = size + known[campaign]["size"], counts + Counter(known[campaign]["counts"])
    known[campaign] = {"size": size, "counts": dict(sorted(counts.items())), "note": note, "date": str(date.today())}
    COUNTS.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")
    rows = [
        f"| {name} | {row['size']:,} | {_told(row['counts'])} | {row['note']} | {row['date']} |"
        for name, row in sorted(known.items())
    ]
    head = PAGE.read_text().partition("| campaign |")[0]
    PAGE.write_text(
        head
        + "\n".join(["| campaign | size | what became of it | of that | run |", "|---|---|---|---|---|", *rows])
        + "\n"
    )


def _told(counts: dict[str, int]) -> str:
    return ", ".join(f"{name}: {number:,}" for name, number in counts.items())
