"""A live session: in-betweens computed while time, stiffnesses, modes and handles of key-frames are dragged.

Shown by viser (extra ``view``), which serves a page for the browser. While the user drags, each shape is the modal
solve of the fast preset. When nothing has changed for a moment, the accurate preset's local steps and the paths of the
handles follow.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torch_modal.arrays import Array, FloatArray, IntArray
from torch_modal.extras import require
from torch_modal.io.write import to_numpy
from torch_modal.keyframes.check import check_keyframes
from torch_modal.precompute.extract import extract_bases
from torch_modal.view.live_shapes import LiveShapes
from torch_modal.view.picture import BETWEEN_COLOR, KEYFRAME_COLOR, up_axis, view_rotation

if TYPE_CHECKING:
    from torch_modal.precompute.basis import ModalBasis

IDLE_SECONDS = 0.25  # without a change, before the accurate shape is computed
STIFFNESS_RANGE = 2.0  # powers of ten, both ways


def live(
    keyframes: Array,
    faces: Array,
    bases: Sequence[ModalBasis] | None = None,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> LiveSession:
    """Start a live session of key-frames: open its ``url`` in a browser.

    Args:
        keyframes: *Shape:* ``(K, V, 3)``, K of 2 or more.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        bases: A basis of each key-frame; computed if not given.
        host: Address of the server: this machine only, or ``"0.0.0.0"`` for the network.
        port: The first port to try.

    Returns:
        The session, which runs in threads of its own until ``stop()``.

    Raises:
        MissingPackageError: viser is not installed.
        MeshError: The key-frames cannot be used; the message says why.
    """
    require_viser()
    checked = check_keyframes(keyframes, faces)
    made = extract_bases(checked.keyframes, checked.faces) if bases is None else list(bases)
    return LiveSession(LiveShapes(checked.keyframes, checked.faces, made), host, port)


def require_viser() -> Any:
    """The module.

    Raises:
        MissingPackageError: It is not installed.
    """
    return require("viser", "view", "a live session")


class LiveSession:
    """The session of :func:`live`: a server, its controls, and a thread that computes the shapes."""

    def __init__(self, shapes: LiveShapes, host: str, port: int) -> None:
        viser = require_viser()
        self.shapes = shapes
        self.faces: IntArray = to_numpy(shapes.faces)
        first = shapes.given[0].numpy()
        low, high = shapes.given.amin((0, 1)).numpy(), shapes.given.amax((0, 1)).numpy()
        self.centre, self.size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        self.n_updates = 0
        self._lock = threading.Lock()  # guards self.shapes
        self._changed = threading.Event()
        self._stopped = threading.Event()
        self._handles: dict[tuple[int, int], Any] = {}  # key-frame and vertex: its control
        self._shown_paths: set[tuple[int, int]] = set()

        self.server: Any = viser.ViserServer(host=host, port=port, verbose=False, label="torch_modal")
        self.url = f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{self.server.get_port()}"
        self._see(first)
        self._add_meshes(first)
        self._add_controls()
        self._thread = threading.Thread(target=self._run, name="torch_modal-live", daemon=True)
        self._thread.start()
        self._changed.set()

    def stop(self) -> None:
        """End the session."""
        self._stopped.set()
        self._changed.set()
        self._thread.join()
        self.server.stop()

    def wait(self) -> None:
        """Return when the session is stopped, or on Ctrl-C, which stops it."""
        try:
            while not self._stopped.wait(0.5):
                pass
        finally:
            if not self._stopped.is_set():
                self.stop()

    # --------------------------------------------------------------------------------------------------- the scene
    def _to_scene(self, points: FloatArray) -> FloatArray:
        """The scene is centred and of the size 2: viser's camera and controls suit that."""
        return (points - self.centre) * (2 / self.size)

    def _from_scene(self, points: Any) -> FloatArray:
        return np.asarray(points, dtype=np.float64) * (self.size / 2) + self.centre

    def _see(self, first: FloatArray) -> None:
        scene, camera = self.server.scene, self.server.initial_camera
        scene.set_up_direction("+y" if up_axis(first) == "y" else "+z")
        scene.configure_default_lights(cast_shadow=False)  # drawn many times a second, also without a graphics card
        camera.position, camera.look_at = 3.3 * view_rotation(first, None, None)[2], (0.0, 0.0, 0.0)
        camera.fov = np.radians(40.0)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")

    def _add_meshes(self, first: FloatArray) -> None:
        def add(name: str, color: tuple[float, ...], opacity: float | None) -> Any:
            rgb = tuple(round(255 * part) for part in color)
            return self.server.scene.add_mesh_simple(
                name, self._to_scene(first), self.faces, color=rgb, opacity=opacity, side="double", cast_shadow=False
            )

        self.between = add("/between", BETWEEN_COLOR, None)
        self.ghosts = [add(f"/keyframe {k}", KEYFRAME_COLOR, 0.3) for k in range(len(self.shapes.given))]
        for k, ghost in enumerate(self.ghosts):
            ghost.vertices = self._to_scene(self.shapes.keyframes[k].numpy())
            ghost.on_click(lambda event, k=k: self._clicked(event, k))

    def _add_controls(self) -> None:
        gui, last = self.server.gui, len(self.shapes.given) - 1
        self.time = gui.add_slider("Time", 0.0, float(last), 0.01, 0.5, marks=tuple(range(last + 1)))
        with gui.add_folder("Stiffness, powers of ten"):
            self.stiffness = [
                gui.add_slider(name, -STIFFNESS_RANGE, STIFFNESS_RANGE, 0.05, 0.0)
                for name in ("Stretching", "Bending", "Volume")
            ]
        with gui.add_folder("Single modes"):
            self.mode_of = gui.add_slider("Key-frame", 0, last, 1, 0)
            self.mode = gui.add_slider("Mode", 1, self.shapes.n_modes, 1, 1)
            self.amount = gui.add_slider("Amount", -2.0, 2.0, 0.02, 0.0)
        self.show_ghosts = gui.add_checkbox("Show key-frames", True)
        self.undo = gui.add_button("Undo all changes")
        self.says = gui.add_markdown("Click on a key-frame to add a handle, and drag it.")
        self.time.on_update(lambda _: self._changed.set())
        for slider in self.stiffness:
            slider.on_update(lambda _: self._set_stiffness())
        self.amount.on_update(lambda _: self._set_mode())
        for chosen in (self.mode_of, self.mode):
            chosen.on_update(lambda _: self._show_amount())
        self.show_ghosts.on_update(lambda _: self._show_ghosts())
        self.undo.on_click(lambda _: self._undo())

    # ------------------------------------------------------------------------------------------------- callbacks
    def _set_stiffness(self) -> None:
        with self._lock:
            self.shapes.set_stiffness(*(10.0**slider.value for slider in self.stiffness))
        self._changed.set()

    def _set_mode(self) -> None:
        with self._lock:
            self.shapes.set_mode(self.mode_of.value, self.mode.value - 1, self.amount.value)
        self._changed.set()

    def _show_amount(self) -> None:
        """The slider shows what the chosen mode of the chosen key-frame has."""
        self.amount.value = self.shapes.amounts[self.mode_of.value].get(self.mode.value - 1, 0.0)

    def _show_ghosts(self) -> None:
        for ghost in self.ghosts:
            ghost.visible = self.show_ghosts.value

    def _clicked(self, event: Any, keyframe: int) -> None:
        shape = self._to_scene(self.shapes.keyframes[keyframe].numpy())
        vertex = hit_vertex(np.array(event.ray_origin), np.array(event.ray_direction), shape, self.faces)
        if vertex is not None:
            self.add_handle(keyframe, vertex)

    def add_handle(self, keyframe: int, vertex: int) -> None:
        """Put a handle on a vertex of a key-frame, where it is now."""
        if (keyframe, vertex) in self._handles:
            return
        place = self._to_scene(self.shapes.keyframes[keyframe, vertex].numpy())
        control = self.server.scene.add_transform_controls(
            f"/handle {keyframe} {vertex}", scale=0.25, disable_rotations=True, depth_test=False, position=place
        )
        control.on_update(lambda _: self._set_handles())
        self._handles[keyframe, vertex] = control
        self._set_handles()

    def move_handle(self, keyframe: int, vertex: int, place: FloatArray) -> None:
        """Move a handle to a place in the caller's coordinates. *Shape:* ``(3,)``."""
        self._handles[keyframe, vertex].position = self._to_scene(np.asarray(place))
        self._set_handles()

    def _set_handles(self) -> None:
        with self._lock:
            for keyframe in range(len(self.ghosts)):
                mine = {v: control for (k, v), control in list(self._handles.items()) if k == keyframe}
                if mine or self.shapes.handles[keyframe]:
                    places = {v: torch.from_numpy(self._from_scene(control.position)) for v, control in mine.items()}
                    self.shapes.set_handles(keyframe, places)
        self._changed.set()

    def _undo(self) -> None:
        with self._lock:
            for control in self._handles.values():
                control.remove()
            self._handles.clear()
            self.shapes.reset()
        self.amount.value = 0.0
        for slider in self.stiffness:
            slider.value = 0.0
        self._set_stiffness()

    # ------------------------------------------------------------------------------------------------- updates
    def _run(self) -> None:
        """Compute the latest state; skips states that changed meanwhile."""
        idle = False
        while not self._stopped.is_set():
            if self._changed.wait(IDLE_SECONDS):
                self._changed.clear()
                idle = False
            elif idle:
                continue
            else:
                idle = True
            if not self._stopped.is_set():
                self._update(accurate=idle)

    def _update(self, accurate: bool) -> None:
        start = time.perf_counter()
        with self._lock:
            shape = self.shapes.shape(self.time.value, accurate).numpy()
            keyframes = self.shapes.keyframes.numpy().copy()
            paths = {key: self.shapes.path(key[1]).numpy() for key in self._handles} if accurate else {}
        with self.server.atomic():
            self.between.vertices = self._to_scene(shape).astype(np.float32)
            for ghost, keyframe in zip(self.ghosts, keyframes, strict=True):
                points = self._to_scene(keyframe).astype(np.float32)
                if not np.array_equal(ghost.vertices, points):
                    ghost.vertices = points
            if accurate:
                self._show_paths(paths)
        self.n_updates += 1
        milliseconds = 1000 * (time.perf_counter() - start)
        if accurate:
            self.says.content = f"With local steps: {milliseconds:.0f} ms. Click on a key-frame to add a handle."

    def _show_paths(self, paths: dict[tuple[int, int], FloatArray]) -> None:
        """Draw the paths of the handles' vertices through all in-betweens."""
        for key in self._shown_paths - set(paths):
            self.server.scene.remove_by_name(f"/path {key[0]} {key[1]}")
        for (keyframe, vertex), path in paths.items():
            self.server.scene.add_spline_catmull_rom(
                f"/path {keyframe} {vertex}",
                self._to_scene(path),
                color=(74, 120, 171),
                thickness=3.0,
                thickness_units="screen",
            )
        self._shown_paths = set(paths)


def hit_vertex(origin: FloatArray, direction: FloatArray, shape: FloatArray, faces: IntArray) -> int | None:
    """The vertex nearest to where a ray first meets a shape, by Cramer's rule on each triangle (Möller, Trumbore 1997).

    Args:
        origin: Where the ray starts. *Shape:* ``(3,)``.
        direction: Where it goes. *Shape:* ``(3,)``.
        shape: *Shape:* ``(V, 3)``.
        faces: *Shape:* ``(F, 3)``.
    """
    a, b, c = shape[faces].transpose(1, 0, 2)
    side, other, away = b - a, c - a, origin - a
    normal = np.cross(direction, other)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / (side * normal).sum(1)
        u = (away * normal).sum(1) * inverse
        turned = np.cross(away, side)
        v = (turned @ direction) * inverse
        far = (other * turned).sum(1) * inverse
        far[~((u >= 0) & (v >= 0) & (u + v <= 1) & (far > 0))] = np.inf
    nearest = int(far.argmin())
    if not np.isfinite(far[nearest]):
        return None
    corners = faces[nearest]
    return int(corners[np.linalg.norm(shape[corners] - (origin + far[nearest] * direction), axis=1).argmin()])
