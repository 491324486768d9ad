"""The ``warp-gi`` command: dispatch, errors and exit codes."""

from __future__ import annotations

import errno
import importlib
import io
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

from warp_gi.errors import GiError, is_of_machine, one_line, unknown_name

EXIT_FAILURE = 1
"""A run failed through no fault of its arguments: a full disk, no memory, a fault of this program. Again may help."""
EXIT_ERROR = 2
"""What was asked for cannot be: another try would fail, too."""
EXIT_INTERRUPTED = 130
DEBUG = "WARP_GI_DEBUG=1 shows where it came from"


@dataclass(frozen=True)
class Command:
    """A subcommand: the module with its ``main(arguments)``, imported when called, and what it does."""

    module: str
    summary: str


COMMANDS = {
    "render": Command("warp_gi.cli.render", "render a sequence of frames to EXR files, with PNG previews"),
    "bake": Command("warp_gi.cli.bake", "compute once what an estimator needs, and save it"),
    "merge": Command("warp_gi.cli.merge", "make one bake of the shards that several processes made"),
    "compare": Command("warp_gi.cli.compare", "measure how far a picture is from its reference"),
    "video": Command("warp_gi.cli.video", "make a film of the frames of a sequence"),
    "info": Command("warp_gi.cli.info", "print what a scene holds"),
    "bench": Command("warp_gi.cli.bench", "run a benchmark suite"),
}

HELP = """usage: warp-gi COMMAND [OPTIONS]

Precomputed and temporally reused global illumination on the CPU and on CUDA.

commands:
{commands}

examples:
  warp-gi render                                     the built-in atrium, with previews, to out/
  warp-gi render hall.glb --environment city.exr --frames 0-47 --spp 64 -o out/hall.####.exr
  warp-gi render hall.glb --resume ...               only the frames that are not there yet
  warp-gi bake hall.glb --cell-size 0.5              once for all skies, to out/hall.dvf.safetensors;
  warp-gi render hall.glb --pipeline dvf --bake out/hall.dvf.safetensors ...   uses it
  warp-gi bake hall.glb --technique light-field-probes   indirect light, to out/hall.probes.safetensors
  warp-gi render out/hall.probes.safetensors         what that bake holds, without the scene
  warp-gi compare out/hall.0000.exr reference.exr    RMSE, relMSE, PSNR, FLIP and a picture of the difference

`warp-gi COMMAND --help` lists the options of a command. Errors are one line on stderr. Exit codes: 0 done, 2 what was
asked for cannot be, 1 another failure (a full disk, no memory), 130 Ctrl-C. WARP_GI_DEBUG=1 shows where it came from.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0 done, 2 a user's mistake, 1 a failure, 130 interrupted."""
    is_process = arguments is None
    if is_process:
        _open_closed_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # names in scenes, and ±, where the terminal has no UTF-8
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            return _dispatch(arguments)
    except BrokenPipeError:  # the reader of our output has gone, as in `warp-gi info x | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (GiError, OSError, MemoryError) as error:
        if os.environ.get("WARP_GI_DEBUG", "0") != "0":
            raise
        print(f"warp-gi: error: {_message(error)}", file=sys.stderr)
        return EXIT_FAILURE if is_of_machine(error) else EXIT_ERROR
    except Exception as error:
        if os.environ.get("WARP_GI_DEBUG", "0") != "0":
            raise
        if isinstance(error, RuntimeError) and "Failed to allocate" in str(error):  # Warp's own allocators
            print(f"warp-gi: error: not enough memory: {_message(error)}", file=sys.stderr)
        else:
            what = f"{type(error).__name__}: {_message(error)}".rstrip(": ")
            print(f"warp-gi: error: a fault of warp-gi, please report it ({what}); {DEBUG}", file=sys.stderr)
        return EXIT_FAILURE
    except KeyboardInterrupt as interrupt:
        if is_process:  # a second Ctrl-C would break off the interpreter's leaving with a traceback
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        print(": ".join(["warp-gi: interrupted", *map(str, interrupt.args)]), file=sys.stderr)
        return EXIT_INTERRUPTED


def _open_closed_streams() -> None:
    """Open what is closed of standard input, output and error, which a file of ours would take the place of."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
    sys.stdout = sys.stdout or open(1, "w", closefd=False)
    sys.stderr = sys.stderr or open(2, "w", closefd=False)


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        listing = "\n".join(f"  {name:<9} {command.summary}" for name, command in COMMANDS.items())
        print(HELP.format(commands=listing))
        return 0 if arguments else EXIT_ERROR
    if arguments[0] in ("-V", "--version"):
        from warp_gi import __version__

        print(f"warp-gi {__version__}")
        return 0
    if arguments[0] not in COMMANDS:
        raise unknown_name("command", arguments[0], COMMANDS)
    return importlib.import_module(COMMANDS[arguments[0]].module).main(arguments[1:])


def _show_warning(message: Warning | str, *where: object, **more: object) -> None:
    print(f"warp-gi: warning: {_message(message)}", file=sys.stderr)


def _message(error: BaseException | str) -> str:
    if isinstance(error, MemoryError):
        return f"not enough memory {error}".strip()
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename2 or error.filename}: {error.strerror}"  # filename2 is the target of a rename
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:  # all else that is written has a name
        return f"standard output: {error.strerror}"
    return one_line(error)


if __name__ == "__main__":
    sys.exit(main())
