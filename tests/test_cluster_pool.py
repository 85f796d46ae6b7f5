"""Tasks of a cluster whose workers died: they are tried alone before one of them is given up. No cluster is needed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from frictrack.base.errors import FrictrackError
from frictrack.flow.batch.cluster import _ClusterPool, _ClusterTask

distributed = pytest.importorskip("distributed")


class Client:
    """Stands for the client of Dask: it notes what is begun, and the test says how that ends."""

    status = "running"

    def __init__(self) -> None:
        self.loop = SimpleNamespace(add_callback=self._call)
        self.begun: list[_ClusterTask] = []

    def submit(self, *_: Any, **__: Any) -> object:
        return object()

    def _call(self, function: Any, *arguments: Any) -> None:
        if function.__name__ == "_follow":
            self.begun.append(arguments[0])
        else:
            function(*arguments)

    @property
    def names(self) -> str:
        """The tasks begun, in order."""
        return "".join(task.arguments[0] for task in self.begun)


def died() -> Exception:
    error: Exception = distributed.KilledWorker("task", SimpleNamespace(address="tcp://10.0.0.2:1"), 3)
    return error


def test_tasks_that_died_together_are_tried_one_by_one_and_alone() -> None:
    client = Client()
    pool = _ClusterPool(client, "tcp://10.0.0.1:8786")
    bad, good = pool.submit(str.upper, "a"), pool.submit(str.upper, "b")
    pool._ended(client.begun[0], None, died())
    assert client.names == "ab"  # not while another one is under way
    pool._ended(client.begun[1], None, died())
    assert client.names == "aba"
    later = pool.submit(str.upper, "c")
    assert client.names == "aba"  # nothing beside it
    pool._ended(client.begun[2], None, died())
    with pytest.raises(FrictrackError, match="the workers that computed it died, 8 times"):
        bad.result(0)
    assert client.names == "abac"
    pool._ended(client.begun[3], "C", None)
    assert client.names == "abacb"
    pool._ended(client.begun[4], "B", None)
    assert (good.result(0), later.result(0)) == ("B", "C")
    pool.submit(str.upper, "d")
    assert client.names == "abacbd"
