"""Attacks in a process of their own, which may crash, hang or be killed: it is started anew."""

from __future__ import annotations

from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import drjit as dr
import mitsuba as mi

import drgs  # noqa: F401  (chooses libLLVM before Dr.Jit is imported)
from support.attacks.attack import Attack
from support.attacks.attack_folder import AttackFolder
from support.attacks.catalogue import attacks
from support.attacks.trial import trial

GRACE_SECONDS = 40.0
"""Seconds beyond an attack's own, after which its process is ended: more than it takes to start."""


class Server:
    """Runs attacks by name; a context manager.

    base: a folder, for the attack folders.
    """

    def __init__(self, base: Path) -> None:
        self._base, self._started, self._process = base, 0, None

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def trial(self, name: str, seconds: float) -> list[str]:
        """Return the faults of an attack; seconds: its time limit."""
        if self._process is None:
            self._started += 1
            context = get_context("spawn")
            self._pipe, theirs = context.Pipe()
            folder = self._base / f"{self._started}"
            self._process = context.Process(target=serve, args=(folder, theirs))
            self._process.start()
            theirs.close()
        self._pipe.send(name)
        if not self._pipe.poll(seconds + GRACE_SECONDS):
            self.stop()
            return ["did not end, in native code"]
        try:
            return self._pipe.recv()
        except (EOFError, OSError):
            return [f"the process ended with {self.stop()}"]

    def stop(self) -> int | None:
        process, self._process = self._process, None
        if process is None:
            return None
        self._pipe.close()
        process.join(timeout=5)
        process.kill()
        process.join()
        return process.exitcode


def serve(base: Path, pipe: Connection) -> None:
    """The other end: answers names with what is wrong."""
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(1)
    attack_folder = AttackFolder(base)

    families: dict[str, dict[str, Attack]] = {}
    with suppress(EOFError, OSError):
        while True:
            name = pipe.recv()
            family = name.partition("/")[0]
            if family not in families:
                families[family] = {a.name: a for a in attacks(family, attack_folder)}
            pipe.send(trial(families[family][name], attack_folder))
