"""Attacks in a process of their own, which may crash, hang or be killed: it is started anew."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from pathlib import Path

from conftest import REPOSITORY, TESTS

GRACE_SECONDS = 40.0
"""Seconds beyond an attack's own, after which its process is ended: more than it takes to start."""


class Server:
    """Runs attacks by name; a context manager.

    base: a folder, for the attack folders.
    """

    def __init__(self, base: Path) -> None:
        self._base, self._started = base, 0
        self._process: subprocess.Popen | None = None

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *error: object) -> None:
        self._stop()

    def trial(self, name: str, seconds: float) -> list[str]:
        """Return the faults of an attack; seconds: its time limit."""
        if self._process is None:
            self._start()
        process = self._process
        process.stdin.write(f"{json.dumps(name)}\n")
        process.stdin.flush()
        ready, _, _ = select.select([process.stdout], [], [], seconds + GRACE_SECONDS)
        answer = process.stdout.readline() if ready else ""
        if answer:
            return json.loads(answer)
        status = self._stop()
        return [f"the process ended with {status}" if ready else "did not end, in native code"]

    def _start(self) -> None:
        self._started += 1
        self._process = subprocess.Popen(
            [sys.executable, "-m", "support.attacks.server", self._base / f"{self._started}"],
            cwd=TESTS,
            env=None,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def _stop(self) -> int | None:
        process, self._process = self._process, None
        if process is None:
            return None
        process.stdin.close()
        try:
            process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()
        return process.returncode


def serve(base: Path) -> None:
    """The other end: answers names, a line each, with what is wrong."""
    import drjit as dr
    import mitsuba as mi

    import drgs  # noqa: F401  (chooses libLLVM before Dr.Jit is imported)
    from support.attacks.attack_folder import AttackFolder
    from support.attacks.catalogue import attacks
    from support.attacks.trial import trial

    # Libraries and commands print to what is the standard output.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(1)
    attack_folder, families = AttackFolder(base), {}
    for line in sys.stdin:
        name = json.loads(line)
        family = name.partition("/")[0]
        if family not in families:
            families[family] = {attack.name: attack for attack in attacks(family, attack_folder)}
        print(json.dumps(trial(families[family][name], attack_folder)), file=answers, flush=True)


if __name__ == "__main__":
    sys.path.insert(0, str(REPOSITORY))
    serve(Path(sys.argv[1]))
