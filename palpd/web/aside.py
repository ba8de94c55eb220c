"""A process beside the server for what is heavy: it imports scipy and matplotlib, computes one thing at a time, and ends when idle.

The server itself stays small and answers aborts while figures are drawn. What is computed may crash or hang; the page then says so.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from palpd.errors import Refused
from palpd.workers import end, started

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor

IDLE_S = 120.0
"""After that time without a question the process ends, and its memory is free."""
PATIENCE_S = 120.0
"""Longest wait for an answer."""
NICE = 15
"""Priority of the process: everything else goes first."""

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")


class Aside:
    """Computes functions of importable modules in one process of low priority, started when it is first needed."""

    def __init__(self) -> None:
        self._pool: ProcessPoolExecutor | None = None
        self._waiting = 0
        self._ending: asyncio.TimerHandle | None = None

    async def compute(self, function: Callable[Arguments, Answer], *arguments: Arguments.args, **named: Arguments.kwargs) -> Answer:
        """Compute `function(*arguments, **named)` there.

        Args:
            function: Of a module's top level; the module is imported in the process. Import what is heavy within the function.
            arguments: Values that can be pickled.
            named: Such values too.

        Returns:
            What the function returns.

        Raises:
            PalpdError: What the function raises; Refused, where it takes too long or its process dies.
        """
        if self._pool is None:
            self._pool = started(1, method="spawn", niceness=NICE)
        if self._ending is not None:
            self._ending.cancel()
        self._waiting += 1
        loop = asyncio.get_running_loop()
        try:
            return await asyncio.wait_for(asyncio.wrap_future(self._pool.submit(function, *arguments, **named)), PATIENCE_S)
        except TimeoutError as error:
            self.close()
            raise Refused(f"this was not computed within {PATIENCE_S:g} s; try again, or use the command line") from error
        except BrokenExecutor as error:
            self.close()
            raise Refused("the process that computes this has died; try again, or use the command line") from error
        finally:
            self._waiting -= 1
            if not self._waiting:
                self._ending = loop.call_later(IDLE_S, self.close)

    def close(self) -> None:
        """End the process, whatever it does."""
        pool, self._pool = self._pool, None
        if pool is not None:
            end(pool)
