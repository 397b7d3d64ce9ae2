"""A page of viser's with one surface that is redrawn whenever something changed."""

from __future__ import annotations

import contextlib
import io
import threading
from types import TracebackType
from typing import Any, Literal, TypeVar

import numpy as np
import viser
from jaxtyping import Float, Int
from torch import Tensor

_SURFACE = (150, 175, 205)
_Window = TypeVar("_Window", bound="Window")


class Window:
    """A page, and the loop that serves it.

    Subclasses say in `follow` what a change does to the surface, and set `_changed` where they hear
    of one: viser calls from threads of its own, the loop works in the caller's.

    Args:
        label: of the page.
        vertices: where the surface is at first.
        faces: its triangles.
        host: whose browsers may open it; 127.0.0.1 for this machine's.
        port: of the page; another one where it is taken.
        up: the axis that is shown upright.
        camera: where it is, from the middle of the surface, in diagonals of its bounding box.
    """

    def __init__(
        self,
        label: str,
        vertices: Float[Tensor, "n 3"],
        faces: Int[Tensor, "m 3"],
        host: str,
        port: int,
        *,
        up: Literal["+y", "+z"] = "+y",
        camera: tuple[float, float, float] = (0.3, 0.4, 1.1),
    ) -> None:
        self._lock = threading.Lock()  # of what the page shows
        self._changed, self._closed = threading.Event(), threading.Event()
        self._camera = np.array(camera)
        with _silence():
            self._server = viser.ViserServer(host, port, label=label, verbose=False)
        self._server.scene.set_up_direction(up)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._server.gui.main_panel.dock_right()
        self._surface = self._server.scene.add_mesh_simple(
            "/surface",
            vertices.numpy().astype(np.float32),
            faces.numpy().astype(np.uint32),
            color=_SURFACE,
            side="double",
        )
        self._aim(vertices)

    @property
    def address(self) -> str:
        """Of the page."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def serve(self) -> None:
        """Let the surface follow its controls until `close`, or an interrupt."""
        while not self._closed.is_set():
            self._changed.wait(timeout=0.2)  # so that an interrupt is heard
            if self._changed.is_set():
                self._changed.clear()
                self.follow()

    def follow(self) -> None:
        """Bring the surface to where the controls have it."""
        raise NotImplementedError

    def close(self) -> None:
        """End the page."""
        self._closed.set()
        with _silence():
            self._server.stop()

    def __enter__(self: _Window) -> _Window:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _aim(self, shown: Float[Tensor, "k 3"]) -> None:
        """The cameras, also of browsers to come: all of it in sight."""
        low, high = shown.amin(0).numpy(), shown.amax(0).numpy()
        middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
        clients = self._server.get_clients().values()
        cameras: list[Any] = [self._server.initial_camera, *(client.camera for client in clients)]
        for camera in cameras:
            camera.position = middle + size * self._camera
            camera.look_at = middle


def _silence() -> contextlib.AbstractContextManager[object]:
    """viser announces itself on the standard output, whatever it is asked."""
    return contextlib.redirect_stdout(io.StringIO())
