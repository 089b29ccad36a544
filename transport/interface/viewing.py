"""The viewer of a run beside the user's own work: it is updated by a thread of this process."""

import html
import threading

from transport.log.run_log import RunLog
from transport.protocol.scenario.setup.run_setup import Setup
from transport.scene.scene_at_tick import SceneBuilder
from transport.viewer.viewer import Viewer


class RunViewer(Viewer):
    """Viewer of a run in this process, at `address`.

    As a context it closes the viewer at its end, as `close()` does.
    """

    def __init__(self, setup: Setup, log: RunLog, host: str, port: int) -> None:
        super().__init__(SceneBuilder.of(setup, log), host=host, port=port, notice=log.cut)
        self._closed = threading.Event()
        self._thread = threading.Thread(
            target=self.show_until, args=(self._closed.is_set,), name="viewer", daemon=True
        )
        self._thread.start()

    def __repr__(self) -> str:
        return f"RunViewer({self.address}{', closed' if self._closed.is_set() else ''})"

    def _repr_html_(self) -> str:
        address = html.escape(self.address)
        frame = f'<iframe src="{address}" width="100%" height="600" style="border:0"></iframe>'
        return f"{frame}<p>{address}</p>"

    def wait(self) -> None:
        """Wait until the viewer is closed."""
        self._closed.wait()

    def close(self) -> None:
        """Stop the server and disconnect the browsers; a second time does nothing."""
        if not self._closed.is_set():
            self._closed.set()
            self._thread.join()
            super().close()
