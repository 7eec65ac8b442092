"""Ray for real: a cluster of two nodes on this machine makes the same bytes as this process."""

import os
import signal
import sys
from pathlib import Path

import pytest
from conftest import EPISODES, checksums, wait_until

from acwm_core.data.generate import generate
from acwm_core.errors import DataError
from tests.extras import needs

HERE = str(Path(__file__).parent)
pytestmark = [pytest.mark.ci, needs("ray")]
SMALL = {"num_cpus": 1, "object_store_memory": 80 * 2**20}


def ray_executor(address):
    from acwm_executors.ray_cluster import RayExecutor

    return RayExecutor(address=address)


@pytest.fixture(scope="module")
def address():
    before = os.environ.get("PYTHONPATH")
    # The workers of the nodes import the square world, and the tests by their own names.
    os.environ["PYTHONPATH"] = os.pathsep.join([HERE, str(Path(__file__).parents[2])])
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={**SMALL, "include_dashboard": False})
    cluster.add_node(**SMALL)
    yield cluster.address
    cluster.shutdown()
    if before is None:
        del os.environ["PYTHONPATH"]
    else:
        os.environ["PYTHONPATH"] = before


def node_of(task, report):
    """Each waits until both nodes, of one core each, are at work."""
    import ray

    number, folder = task
    node = ray.get_runtime_context().get_node_id()
    (folder / node).touch()
    wait_until(lambda: len([*folder.iterdir()]) == 2)
    report(2)
    return number, node


def die_once(marker, report):
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return marker.name


def fail(task, report):
    raise DataError(f"task {task} is impossible")


def path_of_worker(task, report):
    return sys.path


def test_workers_import_nothing_from_the_working_folder(address, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (path,) = ray_executor(address).run(path_of_worker, [0], print)
    assert str(tmp_path) not in path


def test_two_nodes_share_the_tasks_and_report_them(address, tmp_path):
    units, tasks = [], [(number, tmp_path) for number in range(4)]
    results = list(ray_executor(address).run(node_of, tasks, units.append))
    assert sorted(task for task, _ in results) == list(range(4))
    assert len({node for _, node in results}) == 2
    assert sum(units) == 8


@pytest.mark.slow
def test_two_nodes_make_the_same_bytes(address, square_data, tmp_path):
    out = tmp_path / "square"
    executor = ray_executor(address)
    generate("square", out, episodes=EPISODES, executor=executor, shard_episodes=4, progress=False)
    assert checksums(out) == checksums(square_data)


@pytest.mark.slow
def test_a_killed_worker_is_replaced(address, tmp_path):
    markers = [tmp_path / "a", tmp_path / "b"]
    results = ray_executor(address).run(die_once, markers, lambda units: None)
    assert sorted(results) == ["a", "b"]


def test_the_error_of_a_task_is_raised_as_it_is(address):
    with pytest.raises(DataError, match=r"^task 3 is impossible$"):
        list(ray_executor(address).run(fail, [3], lambda units: None))


def test_no_cluster_is_one_sentence():
    with pytest.raises(DataError, match=r"no Ray cluster at 127\.0\.0\.1:9"):
        list(ray_executor("127.0.0.1:9").run(fail, [3], lambda units: None))
