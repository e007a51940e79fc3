"""Threads of xatlas are asleep before it ends them."""

from __future__ import annotations

import threading

from appearance_opt.initial.workers import atlas_at_rest, threads, wait_for_sleep


def test_threads_that_wait_are_asleep_and_threads_that_ended_are_gone() -> None:
    begun, done = threading.Event(), threading.Event()

    def work() -> None:
        begun.set()
        done.wait()

    before = threads()
    thread = threading.Thread(target=work)
    thread.start()
    begun.wait()
    own = {str(thread.native_id)}
    assert own <= threads() - before
    assert wait_for_sleep(own)
    done.set()
    thread.join()
    assert wait_for_sleep(own)


def test_threads_of_an_atlas_are_known() -> None:
    before = threads()
    with atlas_at_rest() as atlas:
        assert threads() > before
    assert wait_for_sleep(threads() - before)
    del atlas
