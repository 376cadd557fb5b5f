"""The server of the pages, one for each browser that comes."""

import contextlib
import io
from collections.abc import Iterator

import viser

from jaxgrasp.viewer.browser.page import Page
from jaxgrasp.viewer.browser.viewed import Viewed


@contextlib.contextmanager
def served(viewed: Viewed, host: str = "127.0.0.1", port: int = 8080) -> Iterator[str]:
    """Serves pages while the block runs; a browser that is reloaded begins anew.

    Args:
        viewed: The grasps.
        host: The address to listen at; only this machine's own browsers reach the default one.
        port: The port; 0 for any that is free.

    Yields:
        The page's address.
    """
    pages: dict[int, Page] = {}
    # It prints a panel of its own.
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label="jaxgrasp", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")

    @server.on_client_connect
    def _(client: viser.ClientHandle) -> None:
        pages[client.client_id] = Page(client, viewed)

    @server.on_client_disconnect
    def _(client: viser.ClientHandle) -> None:
        page = pages.pop(client.client_id, None)
        if page is not None:
            page.close()

    try:
        yield f"http://{host}:{server.get_port()}"
    finally:
        for page in list(pages.values()):
            page.close()
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
