"""The process that a command finds itself in: standard streams, a home, warnings; and what is printed there."""

import contextlib
import os
import sys
from collections.abc import Iterator

# In the order in which they came; a command that is refused says why, and none of them.
_notices: dict[str, None] = {}


def fill_closed_descriptors() -> None:
    """Opens the null device in place of standard streams that are closed: files would get their numbers otherwise."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


@contextlib.contextmanager
def prepared() -> Iterator[None]:
    """Makes the process fit for commands; the package's own warnings are one line each, others are not shown."""
    import logging
    import warnings

    _notices.clear()
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))
        with contextlib.suppress(AttributeError):
            getattr(sys, name).reconfigure(errors="backslashreplace")
    if not os.path.isabs(os.path.expanduser("~")):
        # Libraries look for a home, and know what to do where it cannot be written, but not where there is none.
        os.environ["HOME"] = os.devnull
    # Without any handler Python prints other packages' messages.
    logging.getLogger().addHandler(logging.NullHandler())
    with warnings.catch_warnings():
        if not sys.warnoptions:
            warnings.simplefilter("ignore")
            warnings.filterwarnings("default", message="jaxgrasp")
            warnings.showwarning = lambda message, *_, **__: notice(message)
        yield


def one_line(message: object) -> None:
    """Prints a message on standard error, as one line whatever is in it."""
    from jaxgrasp.storage import printable

    with contextlib.suppress(OSError):
        print(f"jaxgrasp: {printable(' '.join(str(message).split()))}", file=sys.stderr, flush=True)


def notice(message: object) -> None:
    """Keeps a message about work that goes on; `tell_notices` prints it once, however often it comes."""
    _notices[str(message)] = None


def tell_notices() -> None:
    """Prints what was kept and was not printed yet, each message as `one_line` does."""
    for message in _notices:
        one_line(message)
    _notices.clear()


@contextlib.contextmanager
def printing() -> Iterator[None]:
    """Prints to standard output inside this block; a reader who has gone is no error.

    Raises:
        CommandError: Standard output cannot be written, on a full disk for example.
    """
    leaving = None
    try:
        try:
            yield
        except SystemExit as exit:
            # So rich answers a reader who has gone.
            leaving = None if isinstance(exit.__context__, BrokenPipeError) else exit
        sys.stdout.flush()
    except OSError as error:
        # What is still in the buffer would be tried again at the interpreter's end.
        with contextlib.suppress(OSError, AttributeError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            from jaxgrasp.cli.errors import CommandError

            raise CommandError(f"standard output: cannot be written ({error.strerror or error})") from error
    if leaving is not None:
        raise leaving
