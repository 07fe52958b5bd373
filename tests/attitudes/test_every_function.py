"""What holds for every public function of the core: the same bits on any number of threads, and the interpreter is free
while it computes. `catalogue.py` has them at work; a function that is missing there fails the first test."""

from __future__ import annotations

import itertools
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

import weldscan as ws
from catalogue import INSTANT, JOBS, Job, bits, public

SHORTEST_S = 0.04
"""A call must last this long for the lock to be watched: some hundred naps of the other thread."""
PATIENCE_S = 20.0
"""A loaded machine may starve the other thread in one call, but not in all calls of this time."""


def test_the_catalogue_is_complete():
    assert set(JOBS) | set(INSTANT) == public()
    assert not set(JOBS) & set(INSTANT)


@pytest.mark.parametrize("name", JOBS)
def test_the_same_bits_on_any_number_of_threads(name):
    job = JOBS[name](1.0)
    try:
        runs = []
        for threads in (1, 2, 8):
            ws.set_threads(threads)
            runs.append(list(bits(job())))
        assert runs[0] == runs[1] == runs[2]
    finally:
        ws.set_threads(None)


def longest_wait(call: Callable[[], Any]) -> float:
    """The longest time that another Python thread stood still while `call` ran, in parts of the whole call."""
    # From here on a thread has the interpreter until it gives it up by itself.
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e4)
    running, stop = threading.Event(), False
    ticks: list[float] = []

    def tick() -> None:
        while not stop:
            ticks.append(time.perf_counter())
            running.set()
            time.sleep(1e-4)

    other = threading.Thread(target=tick)
    other.start()
    try:
        running.wait()
        start = time.perf_counter()
        call()
        end = time.perf_counter()
    finally:
        stop = True
        sys.setswitchinterval(interval)
        other.join()
    during = [start, *(t for t in ticks if start < t < end), end]
    return max(b - a for a, b in itertools.pairwise(during)) / (end - start)


def is_free(call: Job) -> bool:
    """Whether in some call the other thread never stood still for half of it."""
    until = time.perf_counter() + PATIENCE_S
    while longest_wait(call) >= 0.5:
        if time.perf_counter() > until:
            return False
    return True


@pytest.mark.parametrize("name", JOBS)
def test_another_thread_runs_meanwhile(name):
    scale, job = 1.0, JOBS[name](1.0)
    for _ in range(2):
        start = time.perf_counter()
        job()
        took = time.perf_counter() - start
        if took >= SHORTEST_S or scale > 30:
            break
        scale = min(40.0, scale * 1.5 * SHORTEST_S / took)
        job = JOBS[name](scale)
    assert is_free(job)


def test_a_call_that_keeps_the_lock_is_told_apart(monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "PATIENCE_S", 1.0)
    assert not is_free(lambda: pow(7, 500_000))
    assert is_free(lambda: time.sleep(0.05))
