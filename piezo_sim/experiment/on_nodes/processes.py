# SPDX-License-Identifier: Apache-2.0
"""Node processes: started together, watched, and never left behind."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_prefix

from piezo_sim.experiment.cases import RunFailed

PACKAGE = "piezo_gripper"
GRACE = 5.0  # s that a node has to stop after SIGTERM
LOG_TAIL = 5  # lines of a dead node's log shown in the error
PR_SET_PDEATHSIG = 1


class NodeDied(RunFailed):
    """A node process ended although the experiment still needs it."""


def end_with_parent() -> None:
    """Ask Linux to stop this process when its parent dies, even by SIGKILL."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


class NodeProcesses:
    """Processes of the package's executables; use as a context manager.

    Parameters
    ----------
    commands : mapping of str to sequence of str
        Executable to its command-line arguments; a folder in front tells several of a kind apart.
    log_folder : Path, optional
        Gets one log file per node; without it, what nodes say comes out where this process' own words do.

    Attributes
    ----------
    running : dict of str to subprocess.Popen
        The processes while the context is open.
    """

    def __init__(
        self, commands: Mapping[str, Sequence[str]], log_folder: Path | None = None
    ) -> None:
        self._commands = commands
        self._log_folder = log_folder
        self.running: dict[str, subprocess.Popen] = {}

    def __enter__(self) -> NodeProcesses:
        try:
            for name in self._commands:
                self.start(name)
        except OSError:
            self.stop()
            raise
        return self

    def start(self, name: str) -> None:
        """Start the process `name`; where it was started before, its log goes on."""
        with self._output(name, "ab" if name in self.running else "wb") as output:
            self.running[name] = subprocess.Popen(
                [*self.program(name), *self._commands[name]],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT if output else None,
                start_new_session=True,
                preexec_fn=end_with_parent,
            )

    def program(self, name: str) -> list[str]:
        """Return what is run as `name`: the package's executable."""
        return [str(Path(get_package_prefix(PACKAGE)) / "lib" / PACKAGE / Path(name).name)]

    def __exit__(self, *_: object) -> None:
        self.stop()

    def __len__(self) -> int:
        return len(self.running)

    def check(self) -> None:
        """Raise NodeDied, naming node, exit code and last words, if a process has ended."""
        for name, process in self.running.items():
            code = process.poll()
            if code is not None:
                how = (
                    f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended ({code})"
                )
                if self._log_folder is None:
                    raise NodeDied(f"node '{name}' {how}")
                log = self._log_folder / f"{name}.log"
                words = log.read_text(errors="replace").splitlines()[-LOG_TAIL:]
                raise NodeDied("\n  ".join([f"node '{name}' {how}; log {log}", *words]))

    def stop(self) -> None:
        """End every process: SIGTERM, and SIGKILL for what is still there after the grace period."""
        for process in self.running.values():
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGTERM)
        for process in self.running.values():
            try:
                process.wait(GRACE)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        self.running.clear()

    def _output(self, name: str, mode: str) -> AbstractContextManager[Any]:
        """Return where a node's words go to; None: where those of this process do."""
        if self._log_folder is None:
            return nullcontext()
        log = self._log_folder / f"{name}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        return log.open(mode)
