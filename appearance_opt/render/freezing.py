"""Functions whose kernels are recorded at the first call and launched again without being traced.

A step of a fit traces the same graphs again and again, which takes Python longer than the kernels
of a small image run. ``dr.freeze`` replays them. What may be frozen: a function of arrays that
makes no array as wide as a Python number that changes, reads no array, and compacts nothing. All
arrays it sees must be arguments, or be listed as state.
"""

from __future__ import annotations

import gc
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

if TYPE_CHECKING:
    from collections.abc import Callable

    Run = Callable[..., Any]
    """Calls its first argument with the others: ``traced`` or a ``Frozen``."""

RECORDINGS = 32
"""Recordings kept per function. Arrays that happen to be equally wide, or missing, need one of
their own."""


class Frozen:
    """Calls functions through recordings, which live as long as this object.

    ``state``: objects whose arrays the functions read without being handed them. Other arguments
    than arrays are told apart by their hash: keep objects that are hashed by identity alive as long
    as this one.
    """

    def __init__(self, *state: object) -> None:
        arrays = arrays_in(state)
        self._state_of_call = lambda *_, **__: arrays
        self._frozen: dict[Callable, Any] = {}

    def __call__(self, function: Callable, *arguments: Any) -> Any:
        if function not in self._frozen:
            self._frozen[function] = dr.freeze(
                function, state_fn=self._state_of_call, limit=RECORDINGS, warn_after=10 * RECORDINGS
            )
        # a collection in the middle of a call may drop the recordings of another fit, which Dr.Jit
        # does not survive
        collecting = gc.isenabled()
        gc.disable()
        try:
            return self._frozen[function](*arguments)
        except RuntimeError as error:
            if _interrupted(error):
                raise KeyboardInterrupt from None
            raise
        finally:
            if collecting:
                gc.enable()

    def recordings(self) -> int:
        """Count the recordings made so far."""
        return sum(f.n_recordings for f in self._frozen.values())


def _interrupted(error: BaseException | None) -> bool:
    """Was it Ctrl-C that Dr.Jit reports as an error, or as the cause of one, of a recording or of
    its arguments?"""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__
    return False


def traced(function: Callable, *arguments: Any) -> Any:
    """Call plainly, in place of a ``Frozen``."""
    return function(*arguments)


def arrays_in(*owners: object) -> list:
    """List all Dr.Jit arrays that objects hold, in containers, data classes and attributes, each
    once."""
    found: list = []
    seen: set[int] = set()

    def visit(thing: object) -> None:
        if id(thing) in seen:
            return
        seen.add(id(thing))
        if dr.is_array_v(thing):
            found.append(thing)
        elif isinstance(thing, dict):
            for value in thing.values():
                visit(value)
        elif isinstance(thing, list | tuple):
            for value in thing:
                visit(value)
        elif is_dataclass(thing):
            for f in fields(thing):
                visit(getattr(thing, f.name))
        elif type(thing).__module__.startswith("appearance_opt"):
            for value in vars(thing).values():
                visit(value)

    visit(owners)
    return found
