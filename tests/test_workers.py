"""A map over workers: threads, processes and engines; what a worker that died had to do is done again."""

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import pytest

from sympflow import workers as module
from sympflow.workers import LostWorkers, Unpicklable, checked_workers, mapped

EXPECTED = [3 + i * i for i in range(12)]


def plus_square(common, item):
    return common + item**2


def plus_square_but_die_once(path, item):
    """Kill the own process at item 5, if the file is not there yet."""
    if item == 5:
        try:
            os.close(os.open(path, os.O_CREAT | os.O_EXCL))
            os.kill(os.getpid(), signal.SIGKILL)
        except FileExistsError:
            pass
    return 3 + item**2


def die(common, item):
    os.kill(os.getpid(), signal.SIGKILL)


def fail(common, item):
    raise ZeroDivisionError(f"item {item}")


def collected(function, common, workers, **how):
    found = dict(mapped(function, common, range(12), workers, **how))
    return [found[i] for i in range(12)]


class Futures:
    """An engine whose `.map` returns futures, as dask's does."""

    def __init__(self, pool):
        self.pool = pool

    def map(self, function, items):
        return [self.pool.submit(function, item) for item in items]


def test_engines_of_one_process():
    with ThreadPoolExecutor(2) as pool:
        for workers in (1, 3, map, pool, Futures(pool)):
            assert collected(plus_square, 3, workers) == EXPECTED
            with pytest.raises(ZeroDivisionError, match="item"):
                collected(fail, 3, workers)


class Returns:
    """An engine that does the calls, and returns something else."""

    def __init__(self, returned):
        self.returned = returned

    def map(self, function, items):
        return self.returned([function(item) for item in items])


def test_engines_that_do_not_return_the_results():
    for returned, got in ((lambda _: None, "None"), (lambda _: [], "nothing"), (lambda a: [a[0], 7], "7 among others")):
        with pytest.raises(TypeError, match=rf"`workers` must return the results .*; it returns {got}\."):
            collected(plus_square, 3, Returns(returned))
    few = Returns(lambda answers: [answers[0], *answers[:4]])
    assert collected(plus_square, 3, few) == EXPECTED
    with ThreadPoolExecutor(1) as pool:
        ended = threading.Event()
        pool.submit(ended.wait)
        for workers in (pool, Futures(pool)):
            with pytest.raises(TimeoutError):
                collected(plus_square, 3, workers, timeout=0.05)
        ended.set()


def test_joblib():
    joblib = pytest.importorskip("joblib")
    assert collected(plus_square, 3, joblib.Parallel(2, backend="threading")) == EXPECTED


def test_processes_one_of_which_dies(tmp_path):
    assert collected(plus_square_but_die_once, str(tmp_path / "died"), 2, processes=True) == EXPECTED
    assert (tmp_path / "died").exists()


@pytest.mark.slow
def test_an_executor_one_of_whose_processes_dies(tmp_path):
    context = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(2, context) as pool,
        pytest.warns(RuntimeWarning, match="A process of the executor `workers`"),
    ):
        assert collected(plus_square_but_die_once, str(tmp_path / "died"), pool) == EXPECTED


@pytest.mark.slow
def test_a_pool_one_of_whose_processes_dies(tmp_path):
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        assert collected(plus_square_but_die_once, str(tmp_path / "died"), pool) == EXPECTED


@pytest.mark.slow
def test_workers_that_die_again_and_again():
    with pytest.raises(LostWorkers, match="`workers` died 3 times in a row"):
        collected(die, 0, 2, processes=True)


def test_what_cannot_be_sent():
    with pytest.raises(Unpicklable, match="TypeError"):
        collected(plus_square, threading.Lock(), 2, processes=True)


def test_what_is_no_worker():
    for wrong in (None, "4", 2.0, True, ThreadPoolExecutor):
        with pytest.raises(TypeError, match=r"`workers` must be a number, an object with \.map"):
            checked_workers(wrong)
    for wrong in (0, -2):
        with pytest.raises(ValueError, match="`workers` must be a positive number"):
            checked_workers(wrong)
    assert checked_workers(-1) == module.available_cores()
