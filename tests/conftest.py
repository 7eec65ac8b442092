"""Fixtures for all tests, and one thread of arithmetic for each of their processes.

Test processes run side by side, one per core; threads of small networks that wait for each other
make them many times slower.
"""

import gc
import os
import random
import signal
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read when torch is imported, here and in children

import pytest
from xdist.scheduler import LoadFileScheduling

from acwm_core.plugins import catalog
from tests.browsing import chromium
from tests.scripts import start_server

# A shell that starts tests in the background has them ignore Ctrl-C, which some of them send.
signal.signal(signal.SIGINT, signal.default_int_handler)


DEAREST = (
    "tests/checks/test_environments.py",
    "tests/data/",
    "tests/training/",
    "tests/experiment/",
    "tests/play/",
    "tests/evaluation/",
    "tests/trust/",
    "tests/formats/",
    "tests/checks/",
    "tests/deformable/",
    "tests/zoo/",
    "tests/policies/",
    "",
)
"""Where tests take long, roughly; these come first, so that processes end at about one time."""


def pytest_configure(config):
    """In a run of many tests, workers are forked from a process that has imported what is slow."""
    if hasattr(config, "workerinput"):
        start_server()


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Imports make millions of objects that stay: the garbage collector need not search them."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their markers
def pytest_collection_modifyitems(items):
    """Files stay in one piece, and their tests in order; those that use a browser are marked."""
    for item in items:
        if "browser" in item.fixturenames:
            item.add_marker("browser")
    items.sort(key=lambda item: [item.nodeid.startswith(place) for place in DEAREST].index(True))


class Scheduling(LoadFileScheduling):
    """A file's tests run in one process, as they share fixtures; a world's suite does alone."""

    def _split_scope(self, nodeid):
        return nodeid if "environments_conform[" in nodeid else super()._split_scope(nodeid)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    return Scheduling(config, log)


@pytest.fixture(scope="session", autouse=True)
def references_stay():
    """Tests change copies only: what one adds here, another would read."""
    folder = Path(__file__).with_name("reference")
    before = {path: path.stat().st_size for path in folder.rglob("*")}
    yield
    assert {path: path.stat().st_size for path in folder.rglob("*")} == before


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """What evaluations of tests keep is not left in the user's cache."""
    from acwm_core.data.remote import cache_folder

    usual, own = cache_folder(), tmp_path_factory.mktemp("cache")
    for path in usual.glob("*"):  # such as what was downloaded for pages of play
        if path.name != "references":
            (own / path.name).symlink_to(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ACWM_CACHE", str(own))
        yield


@pytest.fixture(autouse=True)
def seeded():
    """What a test draws without a seed is the same whichever tests ran before it."""
    random.seed(0)
    for module, seed in (("numpy.random", "seed"), ("torch", "manual_seed")):
        if module in sys.modules:
            getattr(sys.modules[module], seed)(0)


@pytest.fixture(scope="module")
def browser():
    """One for the tests of a module: as long as it is open, nothing else can run an event loop."""
    yield from chromium()


@pytest.fixture
def fresh_catalog():
    """A catalog that finds the plugins anew; afterwards the one that other tests added to."""
    before = catalog()
    catalog.cache_clear()
    yield
    catalog.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("acwm_core.plugins.Catalog", lambda: before)
        patch.setattr(before, "load_entry_points", lambda: None)
        assert catalog() is before
