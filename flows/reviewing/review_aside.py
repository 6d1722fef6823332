"""Work of a tab that must not hold up the page: done in another thread, its result brought back."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any

from bokeh.document import Document


class Aside:
    """Work for one tab.

    Args:
        pool: does the work; on_error: called in the tab with an error's message.
    """

    def __init__(self, doc: Document, pool: Executor, on_error: Callable[[str], None]) -> None:
        self._doc, self._pool, self._on_error = doc, pool, on_error
        self._closed = False

    def do(
        self,
        work: Callable[[], Any],
        then: Callable[[Any], None] = lambda _: None,
        otherwise: Callable[[], None] = lambda: None,
    ) -> None:
        """Do `work` in the pool, and `then` with its result in the tab, or `otherwise`."""

        def back(done: Future[Any]) -> None:
            if not self._closed:
                self._doc.add_next_tick_callback(partial(finish, done))

        def finish(done: Future[Any]) -> None:
            error = done.exception()
            if error is None:
                then(done.result())
            else:
                self._on_error(f"{type(error).__name__}: {error}")
                otherwise()

        self._pool.submit(work).add_done_callback(back)

    def close(self) -> None:
        """The tab is gone: results are dropped from now on."""
        self._closed = True
