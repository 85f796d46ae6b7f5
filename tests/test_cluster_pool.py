"""Tasks of a cluster whose workers died: they are tried alone before one of them is given up. No cluster is needed."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from frictrack.base.errors import FrictrackError
from frictrack.flow.batch.cluster import _ClusterPool

distributed = pytest.importorskip("distributed")


class Begun:
    """A task that Dask has begun; the test says how it ends."""

    status = "pending"

    def __init__(self, name: str) -> None:
        self.name = name
        self.end: asyncio.Future[Any] = asyncio.get_running_loop().create_future()

    def dies(self) -> None:
        self.status = "error"
        self.end.set_exception(distributed.KilledWorker("task", SimpleNamespace(address="tcp://10.0.0.2:1"), 3))

    def returns(self, value: str) -> None:
        self.status = "finished"
        self.end.set_result(value)


class Client:
    """Stands for the client of Dask."""

    status = "running"

    def __init__(self) -> None:
        loop = asyncio.get_running_loop()
        self.running: list[asyncio.Task[Any]] = []
        self.loop = SimpleNamespace(add_callback=lambda run, *given: self.running.append(loop.create_task(run(*given))))
        self.begun: list[Begun] = []

    def submit(self, call: Any, function: Any, arguments: tuple[str, ...], **how: Any) -> Begun:
        self.begun.append(Begun(arguments[0]))
        return self.begun[-1]

    async def gather(self, one: Begun, *, asynchronous: bool) -> Any:
        return await one.end

    async def names(self) -> str:
        """The tasks begun, in order."""
        for _ in range(20):
            await asyncio.sleep(0)
        return "".join(one.name for one in self.begun)


def test_tasks_that_died_together_are_tried_one_by_one_and_alone() -> None:
    asyncio.run(try_tasks())


async def try_tasks() -> None:
    client = Client()
    pool = _ClusterPool(client, "tcp://10.0.0.1:8786")
    bad, good = pool.submit(str.upper, "a"), pool.submit(str.upper, "b")
    assert await client.names() == "ab"
    client.begun[0].dies()
    assert await client.names() == "ab"  # not while another one is under way
    client.begun[1].dies()
    await client.names()
    later = pool.submit(str.upper, "c")
    while not all(one.done() for one in (bad, good, later)):
        await client.names()
        under_way = [one for one in client.begun if not one.end.done()]
        assert under_way
        assert len(under_way) == 1 or {one.name for one in under_way} == {"c"}  # nothing beside a suspect
        one = under_way[0]
        one.dies() if one.name == "a" else one.returns(one.name.upper())
        await client.names()
    assert sorted(one.name for one in client.begun) == ["a", "a", "b", "b", "c"]
    with pytest.raises(FrictrackError, match="the workers that computed it died, 8 times"):
        bad.result(0)
    assert (good.result(0), later.result(0)) == ("B", "C")
