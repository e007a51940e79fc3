"""Which kernels do steps of a fit need?

Kernels exist in up to two variants, by the alignment of the memory that NumPy hands over, and the
second is met at random, perhaps long after the first steps: a single new kernel proves nothing.
"""

from __future__ import annotations

import drjit as dr

from appearance_opt.optimize.loop import FitRun

BLOCK, MOST = 8, 15
FIRST, LATER, CHANCE = 16, 47, 6


class Kernels:
    """Those that a fit has launched so far, by the hash of their code. (Whether one was compiled
    says less: that of an earlier process comes from Dr.Jit's cache on disk.)"""

    def __init__(self, run: FitRun) -> None:
        self.run = run
        self.seen: set = set()

    def new(self, steps: int) -> int:
        """How many of the next steps' were not seen before?"""
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            for _ in range(steps):
                self.run.advance()
            history = dr.kernel_history()
        assert history
        launched = {k["hash"] for k in history if k["type"] == dr.KernelType.JIT}
        new = launched - self.seen
        self.seen |= launched
        return len(new)


def settles(run: FitRun) -> bool:
    """Does a fit come to need nothing new? True once ``BLOCK`` steps in a row launched no new
    kernel: what changes in every step, or at every change of level, never gets there. It says
    nothing of what happens less often."""
    kernels = Kernels(run)
    return any(kernels.new(BLOCK) == 0 for _ in range(MOST))


def looks_settle(run: FitRun, steps: int) -> bool:
    """The same of a fit with a look in every ``steps`` steps: after ``FIRST`` looks, at most
    ``CHANCE`` of ``LATER`` bring new kernels. Measured: up to seven kernels after 16 steps, three
    after 64. What changes at every look, or at every fourth, brings more."""
    kernels = Kernels(run)
    new = [kernels.new(steps) > 0 for _ in range(FIRST + LATER)]
    return sum(new[FIRST:]) <= CHANCE
