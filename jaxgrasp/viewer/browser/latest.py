"""Work that follows somebody who drags a slider: the last request counts, those that it overtakes are left out."""

import threading
from collections.abc import Callable


class Latest:
    """Calls a function for the last of many requests, one call at a time."""

    def __init__(self, work: Callable[[], None]):
        """Takes what is to be done; it looks at its inputs when it begins."""
        self._work = work
        self._lock = threading.Lock()
        self._wanted = self._running = False

    def __call__(self) -> None:
        """Asks for the work: does it, and again where others have asked meanwhile, or leaves it to who does it now."""
        with self._lock:
            self._wanted = True
            if self._running:
                return
            self._running = True
        try:
            while self._begin():
                self._work()
        except BaseException:
            with self._lock:
                self._running = False
            raise

    def overtaken(self) -> bool:
        """Whether there is a request that the work under way does not answer."""
        with self._lock:
            return self._wanted

    def _begin(self) -> bool:
        with self._lock:
            self._running, self._wanted = self._wanted, False
            return self._running
