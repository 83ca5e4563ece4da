"""Run attacks by name, and print what is wrong: see the package."""

from __future__ import annotations

import sys
import time
from fnmatch import fnmatch
from pathlib import Path
from tempfile import TemporaryDirectory

import mitsuba as mi

import drgs  # noqa: F401  (chooses libLLVM before Dr.Jit is imported)
from support.attacks.attack_folder import AttackFolder
from support.attacks.catalogue import FAMILIES, attacks
from support.attacks.server import Server


def main(patterns: list[str]) -> None:
    """Run the attacks whose names match one of the patterns; none: count them."""
    mi.set_variant("llvm_ad_rgb")
    with TemporaryDirectory(prefix="attacks-") as base, Server(Path(base)) as server:
        attack_folder = AttackFolder(Path(base) / "here")
        for family in FAMILIES:
            if not patterns:
                print(f"{family}: {len(attacks(family, attack_folder))}")
            elif any(pattern.partition("/")[0] == family for pattern in patterns):
                for attack in attacks(family, attack_folder):
                    if any(fnmatch(attack.name, p) or attack.name == p for p in patterns):
                        started = time.perf_counter()
                        wrong = server.trial(attack.name, attack.seconds)
                        print(f"{time.perf_counter() - started:6.2f} s  {attack.name}")
                        print(*(f"          WRONG: {line}\n" for line in wrong), sep="", end="")
                        sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
