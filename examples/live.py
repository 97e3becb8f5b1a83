"""A motion edited by hand in the browser: key-frames are dragged and added, vibration modes are laid over.

    pip install viser
    python examples/live.py [open.obj fist.obj ...] [--port 8080]

Without files, the sample creature gallops. Orange shapes are key-frames, the blue one is the motion at the time of the
slider. A click on a key-frame puts a handle on a vertex: drag it, and the key-frame bends in the space of its modes.
"Pin" makes a key-frame of the present shape. The amplitudes bend the whole motion by modes of its first key-frame.
"""

from __future__ import annotations

import argparse
import threading
from pathlib import Path
from typing import Any

import numpy as np
import torch
import viser
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample

GIVEN, COMPUTED, TRAIL = (232, 153, 92), (158, 181, 209), (74, 120, 171)
N_AMPLITUDES = 4
SLACK = 1e-6
"""Part of the mean compliance by which handles may be missed, so that close handles do not conflict."""


class Keyframe:
    """A key-frame: its shape without handles, the basis that it bends in, its mesh in the scene, and its handles."""

    def __init__(self, shape: Tensor, basis: tm.ModalBasis, ghost: Any) -> None:
        self.shape, self.basis, self.ghost = shape, basis, ghost
        self.handles: dict[int, Any] = {}  # vertex: its control

    def bent(self, places: Tensor) -> Tensor:
        """The shape of least linear elastic energy whose vertices with handles are at these places.

            minimise  1/2 sum_i lambda_i a_i^2    such that  Phi_h a = d

        Args:
            places: *Shape:* ``(n, 3)``.

        Returns:
            *Shape:* ``(V, 3)``.
        """
        vertices, modes = list(self.handles), self.basis.modes
        moves = (places - self.shape[vertices]).flatten()
        seen = modes[:, vertices].flatten(1)  # Phi_h^T, (k, 3n)
        soft = seen / self.basis.eigenvalues[:, None]
        compliance = seen.T @ soft
        slack = SLACK * compliance.diagonal().mean() * torch.eye(len(moves), dtype=moves.dtype)
        amplitudes = soft @ torch.linalg.solve(compliance + slack, moves)
        return self.shape + torch.einsum("k,kvc->vc", amplitudes, modes)


class Live:
    """The scene, its controls, and the motion that they edit.

    Args:
        keyframes: *Shape:* ``(K, V, 3)``, K of 2 or more.
        faces: *Shape:* ``(F, 3)``.
        port: The first port to try.
        n_modes: Modes of each key-frame.
    """

    def __init__(self, keyframes: Tensor, faces: Tensor, port: int = 8080, n_modes: int = 20) -> None:
        keyframes = keyframes.double()
        bases = tm.extract_bases(keyframes, faces, n_modes)
        path = tm.Path(bases, faces)
        self.faces = faces
        self.editor = tm.PathEditor(path, keyframes)
        self.decoder = tm.ModalDecoder(keyframes, faces, path.times, keyframes[0], bases[0].modes[:N_AMPLITUDES])
        low, high = keyframes.amin((0, 1)), keyframes.amax((0, 1))
        self.centre, self.size = (low + high) / 2, (high - low).norm()
        self.lock = threading.Lock()  # viser calls back in threads of its own
        self.changed = threading.Event()
        self.edited: set[int] = set()  # key-frames whose handles have moved

        self.server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False, label="torch_modal")
        self.server.scene.set_up_direction("+y")
        self.server.initial_camera.position = (1.8, 1.2, 2.6)
        self.mesh = self.add_mesh("/motion", keyframes[0], COMPUTED, None)
        self.keyframes: list[Keyframe] = []
        for shape, basis in zip(keyframes, bases, strict=True):
            self.add_keyframe(len(self.keyframes), shape, basis)
        gui = self.server.gui
        self.time = gui.add_slider("Time", 0.0, float(path.times[-1]), 0.01, 0.5)
        gui.add_button("Pin", hint="Makes a key-frame of the present shape").on_click(lambda _: self.insert())
        with gui.add_folder("Amplitudes"):
            self.amplitudes = [gui.add_slider(f"Mode {i + 1}", -20.0, 20.0, 0.1, 0.0) for i in range(N_AMPLITUDES)]
        for control in (self.time, *self.amplitudes):
            control.on_update(lambda _: self.changed.set())
        self.changed.set()

    def to_scene(self, points: Tensor) -> np.ndarray:
        """Points in the scene, which is centred and of the size 2. *Shape:* ``(..., 3)``."""
        return ((points - self.centre) * (2 / self.size)).numpy().astype(np.float32)

    def add_mesh(self, name: str, shape: Tensor, color: tuple[int, int, int], opacity: float | None) -> Any:
        """A mesh of the scene."""
        return self.server.scene.add_mesh_simple(
            name, self.to_scene(shape), self.faces.numpy(), color=color, opacity=opacity, side="double"
        )

    def add_keyframe(self, number: int, shape: Tensor, basis: tm.ModalBasis) -> None:
        """Show a key-frame, which can be clicked on."""
        ghost = self.add_mesh(f"/keyframe {len(self.keyframes)}", shape, GIVEN, 0.3)
        keyframe = Keyframe(shape, basis, ghost)
        self.keyframes.insert(number, keyframe)
        ghost.on_click(lambda event: self.add_handle(keyframe, self.hit_vertex(keyframe, event)))

    def hit_vertex(self, keyframe: Keyframe, event: Any) -> int:
        """The nearest of the vertices along a ray, or the one beside it."""
        direction = np.array(event.ray_direction) / np.linalg.norm(event.ray_direction)
        offset = np.asarray(keyframe.ghost.vertices) - np.array(event.ray_origin)
        along = offset @ direction
        aside = np.linalg.norm(offset - along[:, None] * direction, axis=1)
        return int(np.where(aside <= max(0.03, aside.min()), along, np.inf).argmin())

    def add_handle(self, keyframe: Keyframe, vertex: int) -> None:
        """Put a handle on a vertex of a key-frame, where it is now."""
        if vertex in keyframe.handles:
            return
        place = self.to_scene(self.editor.keyframes[self.keyframes.index(keyframe), vertex])
        control = self.server.scene.add_transform_controls(
            f"{keyframe.ghost.name}/{vertex}", scale=0.25, disable_rotations=True, depth_test=False, position=place
        )
        with self.lock:
            keyframe.handles[vertex] = control
        control.on_update(lambda _: self.move_handles(keyframe))

    def move_handles(self, keyframe: Keyframe) -> None:
        """Have a key-frame follow its handles, with the next update."""
        with self.lock:
            self.edited.add(self.keyframes.index(keyframe))
        self.changed.set()

    def insert(self) -> None:
        """Make a key-frame of the present shape, with the modes of the nearest one."""
        with self.lock, torch.no_grad():
            when = self.time.value
            nearest = int((self.editor.path.times - when).abs().argmin())
            try:
                number = self.editor.insert(when, self.shape())
            except ValueError:  # at this time there is one
                return
            self.edited = {i + (i >= number) for i in self.edited}
            self.decoder = self.decoder.with_keyframes(self.editor.keyframes, self.editor.path.times)
            self.add_keyframe(number, self.editor.keyframes[number].clone(), self.keyframes[nearest].basis)
        self.changed.set()

    def shape(self) -> Tensor:
        """The motion at the slider's time, with its amplitudes. *Shape:* ``(V, 3)``."""
        amplitudes = torch.tensor([slider.value for slider in self.amplitudes], dtype=torch.float64)
        if not amplitudes.any():
            return self.editor.path(self.editor.keyframes, self.time.value)
        return self.decoder(amplitudes, self.time.value, keyframes=self.editor.keyframes)

    @torch.no_grad()
    def update(self) -> None:
        """Bring the motion and what is shown of it to the controls."""
        with self.lock, self.server.atomic():
            for number in self.edited:
                keyframe = self.keyframes[number]
                places = torch.tensor(np.array([control.position for control in keyframe.handles.values()]))
                self.editor.replace(number, keyframe.bent(places * (self.size / 2) + self.centre))
                keyframe.ghost.vertices = self.to_scene(self.editor.keyframes[number])
            self.mesh.vertices = self.to_scene(self.shape())
            if self.edited:
                shapes = self.editor.shapes()
                for vertex in {v for keyframe in self.keyframes for v in keyframe.handles}:
                    trail = self.to_scene(shapes[:, vertex])
                    self.server.scene.add_spline_catmull_rom(f"/trail {vertex}", trail, color=TRAIL)
            self.edited.clear()


def main() -> None:
    """Start the session."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="*", type=Path, help="key-frames; by default those of a sample")
    parser.add_argument("--port", type=int, default=8080)
    args = parser.parse_args()
    sample = load_sample("creature")
    keyframes, faces = tm.load_keyframes(args.meshes) if args.meshes else (sample.keyframes, sample.faces)
    live = Live(keyframes, faces, args.port)
    print(f"open http://127.0.0.1:{live.server.get_port()} in a browser; Ctrl-C ends the session", flush=True)
    try:
        while live.changed.wait():
            live.changed.clear()
            live.update()
    finally:
        live.server.stop()


if __name__ == "__main__":
    main()
