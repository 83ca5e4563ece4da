"""What the stages of a training iteration cost: launches, bytes, instructions of their loops."""

from __future__ import annotations

from dataclasses import dataclass

from drgs.bench.blocks import vector_trips
from drgs.bench.machine_code import (
    MachineCodeError,
    assembly,
    count_operations,
    innermost_loop,
)
from drgs.bench.profile import CountedLaunch
from drgs.bench.traffic import bytes_of
from drgs.splatting.grid import PIXELS

COPIES = ("Memset", "Memcpy")
"""What is no kernel, though the history lists it."""


@dataclass(frozen=True)
class StageCost:
    """Of one stage in one iteration."""

    kernels: int  # launched
    bytes: int  # that they ask for; see drgs.bench.traffic


@dataclass(frozen=True)
class LoopCost:
    """Of the loop over pairs of a pixel and a Gaussian, from its machine code.

    All but ``steps`` are instructions *a pair*: those in the loop's body, divided by the pixels of
    a lane. An instruction that computes, loads or stores a vector, one number for each lane, thus
    counts as one for each of the pairs that it serves, as in ``INSTRUCTIONS`` of the command. What
    a lane does for all of its pixels counts a sixteenth; records are loaded lane by lane, since
    they lie apart. Paths that are hardly ever taken are counted too.

    The stack has what registers have no room for: state of pixels, which the loop stores and loads
    again for each Gaussian.
    """

    vectors: float  # instructions with a vector register, moves included
    loads: float  # of data: records, gradients of pixels
    stores: float  # of data
    stack_loads: float
    stack_stores: float
    constants: float  # loads of numbers that stand beside the code
    steps: int  # how often vectors went through the loop

    def instructions(self) -> float:
        """Vector instructions that were executed."""
        return self.vectors * PIXELS * self.steps


def stage_costs(launches: dict[str, list[CountedLaunch]]) -> dict[str, StageCost]:
    """By stage."""
    return {
        stage: StageCost(
            kernels=sum(counted.launch.type not in COPIES for counted in found),
            bytes=sum(bytes_of(counted.launch, counted.trips) for counted in found),
        )
        for stage, found in launches.items()
    }


def loop_cost(launches: list[CountedLaunch], width: int) -> LoopCost:
    """Of the loop in the kernel of a stage that takes longest, in all launches of that kernel.

    Raises :class:`MachineCodeError` where it cannot be had.
    """
    longest = max(
        (counted for counted in launches if counted.trips),
        key=lambda counted: counted.launch.milliseconds,
        default=None,
    )
    if longest is None:
        raise MachineCodeError("the stage has no kernel with a loop")
    text = assembly(longest.launch.ir)
    found = count_operations(innermost_loop(text), text)
    return LoopCost(
        vectors=found.vectors / PIXELS,
        loads=found.loads / PIXELS,
        stores=found.stores / PIXELS,
        stack_loads=found.stack_loads / PIXELS,
        stack_stores=found.stack_stores / PIXELS,
        constants=found.constants / PIXELS,
        steps=sum(
            vector_trips(trips, width)
            for counted in launches
            if counted.launch.ir == longest.launch.ir
            for trips in counted.trips
        ),
    )
