"""Attacks in a process of their own, which may crash, hang or be killed: it is started anew."""

from __future__ import annotations

import multiprocessing
import tempfile
from functools import cache
from pathlib import Path

import drjit as dr
import mitsuba as mi

import drgs  # noqa: F401  (chooses libLLVM before Dr.Jit is imported)
from support.attacks.attack import Attack
from support.attacks.attack_folder import AttackFolder
from support.attacks.catalogue import attacks
from support.attacks.trial import trial

GRACE_SECONDS = 40.0  # beyond an attack's own: more than a process takes to start


class Server:
    """Runs attacks by name; a context manager. base: a folder, for the attack folders."""

    def __init__(self, base: Path) -> None:
        self._base, self._pool = base, None

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool is not None:
            self._pool.terminate()

    def trial(self, name: str, seconds: float) -> list[str]:
        """Return the faults of an attack; seconds: its time limit."""
        if self._pool is None:
            self._pool = multiprocessing.get_context("spawn").Pool(1, _start, (self._base,))
        try:
            return self._pool.apply_async(_run, (name,)).get(seconds + GRACE_SECONDS)
        except multiprocessing.TimeoutError:
            self._pool.terminate()
            self._pool = None
            return ["the process crashed, or did not end, in native code"]


_folders: list[AttackFolder] = []  # that of a process of the pool


def _start(base: Path) -> None:
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(1)
    _folders.append(AttackFolder(Path(tempfile.mkdtemp(dir=base))))


@cache
def _attacks_of(family: str) -> dict[str, Attack]:
    return {attack.name: attack for attack in attacks(family, _folders[0])}


def _run(name: str) -> list[str]:
    return trial(_attacks_of(name.partition("/")[0])[name], _folders[0])
