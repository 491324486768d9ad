"""A Dask scheduler and workers in processes of their own, as a user starts them."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager


class Workers:
    """A running scheduler, its address, and the workers, which can be killed and started."""

    def __init__(self, folder, environment):
        self.folder, self.environment = folder, environment
        self.processes = []
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        self.scheduler = self._start("scheduler", "--host", self.address, "--no-dashboard", "--no-show")

    def start(self, count=1, **environment):
        """Start workers of one thread each, without a nanny: a killed one stays away."""
        for _ in range(count):
            options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "60"]
            self.processes.append(self._start("worker", self.address, *options, **environment))

    def kill(self, number=0):
        """Kill a worker at once."""
        process = self.processes.pop(number)
        process.send_signal(signal.SIGKILL)
        process.wait()

    def stop(self):
        for process in [*self.processes, self.scheduler]:
            process.kill()
        for process in [*self.processes, self.scheduler]:
            process.wait()

    def _start(self, *command, **environment):
        log = open(self.folder / f"{command[0]}-{time.monotonic_ns()}.log", "w")
        with log:
            return subprocess.Popen(
                [sys.executable, "-m", "distributed.cli.dask_" + command[0], *command[1:]],
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=self.folder,
                env=os.environ | self.environment | environment,
            )


@contextmanager
def workers(folder, count, **environment):
    """Yield a scheduler with ``count`` workers that have come."""
    from distributed import Client

    running = Workers(folder, environment)
    try:
        running.start(count)
        with Client(running.address, timeout=60, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=60)
        yield running
    finally:
        running.stop()
