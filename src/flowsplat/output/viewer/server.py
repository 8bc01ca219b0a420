"""``flowsplat view``: serves the viewer until it is stopped."""

from __future__ import annotations

import contextlib
import io
import threading
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from flowsplat.common.devices import pick_device
from flowsplat.common.errors import InputError, describe_install
from flowsplat.common.progress import report
from flowsplat.output.viewer.guard import Guard, check_address, guard_server, is_guarded
from flowsplat.output.viewer.options import ViewOptions
from flowsplat.output.viewer.source import Source
from flowsplat.output.viewer.worker import Worker

if TYPE_CHECKING:
    import viser

    from flowsplat.output.viewer.panel import Panel


class Viewer:
    """The viewer of a run: one server, one worker, and a panel for every client."""

    def __init__(self, folder: Path, options: ViewOptions):
        """Open the run and begin to serve.

        Raises:
            InputError: viser is missing, the run has nothing to show yet, the device does not work, or the address cannot be
                listened on.
        """
        _check_options(options)
        self._options = options
        self.source = Source(folder, pick_device(options.device))
        check_address(options.host, options.port)
        self.guard = Guard.of(options.host, options.port)
        self._server = _serve(options, self.guard)
        self._panels: dict[int, Panel] = {}
        self._lock = threading.Lock()
        self.worker = Worker(self.source, self._reload)
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)
        self.worker.start()

    def stop(self) -> None:
        """Stop serving and rendering."""
        self.worker.stop()
        with _quiet():
            self._server.stop()

    def _connect(self, client: viser.ClientHandle) -> None:
        from flowsplat.output.viewer.panel import Panel

        panel = Panel(client, self.source, self.worker, self._options.largest)
        with self._lock:
            self._panels[client.client_id] = panel
        panel.begin()

    def _begin_anew(self, panel: Panel) -> None:
        """Give a client the controls of another scene."""
        self.worker.remove(panel.client.client_id)
        panel.end()
        self._connect(panel.client)

    def _disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            panel = self._panels.pop(client.client_id, None)
        if panel is not None:
            panel.leave()
        self.worker.remove(client.client_id)

    def _reload(self) -> None:
        with self._lock:
            panels = list(self._panels.values())
        for panel in panels:
            try:
                if panel.scene is self.source.scene:
                    panel.reload()
                elif self._panels.get(panel.client.client_id) is panel:  # Others have left meanwhile.
                    self._begin_anew(panel)
            except Exception as error:  # One client's bad luck must not keep the newer model from the others.
                report(f"A client could not be told of the newer model: {type(error).__name__}: {error}")


def check_serving(options: ViewOptions) -> None:
    """Refuse what the viewer could not serve with, before anything is made that it would show.

    Raises:
        InputError: an option cannot be used, viser is missing, the device does not work, or the address cannot be listened on.
    """
    _check_options(options)
    check_address(options.host, options.port)
    pick_device(options.device)


def view(folder: Path, options: ViewOptions) -> None:
    """Serve the viewer of a run until Ctrl-C.

    Raises:
        InputError: see ``Viewer``.
    """
    viewer = Viewer(folder, options)
    try:
        source = viewer.source
        what = f"{folder} ({source.loaded.state})" if source.file is None else f"{source.file} (what is saved goes into {folder})"
        report(f"Showing {what}: {viewer.guard.address} - Ctrl-C stops.")
        if viewer.guard.token is not None:
            report("Every computer that reaches this one can open the viewer, with this whole address; it is new each time.")
        threading.Event().wait()
    except KeyboardInterrupt:
        report("The viewer is stopped.")
    finally:
        viewer.stop()


def _quiet() -> contextlib.AbstractContextManager[object]:
    """Without what viser prints: its address may not be the one to open, and we say ourselves what happens."""
    return contextlib.redirect_stdout(io.StringIO())


def _check_options(options: ViewOptions) -> None:
    """Refuse options that nothing could be served with, and a machine without viser."""
    if not 64 <= options.largest <= 8192:
        raise InputError(f"Images of {options.largest} pixels cannot be shown: give --largest from 64 to 8192.")
    try:
        import viser  # noqa: F401 (the one thing that may be missing)
    except ImportError as error:
        raise InputError(f"The viewer needs viser: {describe_install('view')}.") from error


def _serve(options: ViewOptions, guard: Guard) -> viser.ViserServer:
    import viser

    # A browser may be closed while an image is on its way to it.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    with _quiet(), guard_server(guard):
        server = viser.ViserServer(host=options.host, port=options.port, label="flowsplat", verbose=False)
    if server.get_port() != options.port:
        server.stop()
        raise InputError(f"Port {options.port} is in use: choose another one with --port.")
    if not is_guarded(options.host, options.port):
        server.stop()
        raise InputError(f"viser {viser.__version__} cannot be kept from other pages: install the one that constraints.txt names.")
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    return server
