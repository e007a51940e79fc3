"""How many kernels do steps of a fit compile?"""

from __future__ import annotations

import drjit as dr

from appearance_opt.fit.loop import _Run

BLOCK, MOST = 8, 15


def compiled(run: _Run, steps: int) -> int:
    """Kernels compiled during the next ``steps`` steps."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for _ in range(steps):
            run.advance()
        history = dr.kernel_history()
    assert history
    return sum(k["type"] == dr.KernelType.JIT and not k["cache_hit"] for k in history)


def settles(run: _Run) -> bool:
    """Does a fit come to compile nothing? True once ``BLOCK`` steps in a row compiled no kernel.

    Kernels exist in up to two variants, by the alignment of the memory that NumPy hands over; the second is met at
    random, so the first clean block may come late. What compiles in every step, or at every change of level, never
    has a clean block.
    """
    return any(compiled(run, BLOCK) == 0 for _ in range(MOST))
