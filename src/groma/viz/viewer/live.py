# SPDX-License-Identifier: BSD-3-Clause
"""A running track in the browser: its path, keyframes, points, lines and planes so far.

``groma track`` writes finished keyframes to ``OUT.work`` while it runs, and ``OUT`` at its end. This module reads these
files whenever they change, and draws them on a viser server. The panel shows the current picture with its tracked
features, the statuses of the frames, and switches.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from groma._counted import counted, duration
from groma._typing import FloatArray
from groma.bounded.text import finite, read_words
from groma.errors import GromaError
from groma.geometry import quaternion, se3
from groma.io import read_scene
from groma.io.reading import reading
from groma.io.trajectories import read_tum
from groma.scene.patches import plane_patches
from groma.viz.colours import of_lines
from groma.viz.pack import thin
from groma.viz.viewer import arrays as _view_arrays
from groma.viz.viewer.glance import Picture, Statuses, read_now, read_statuses, timeline
from groma.viz.viewer.server import Say, keep_cameras, start_server, stop_server

if TYPE_CHECKING:
    import viser

    from groma.scene import Scene

#: Seconds between two checks of the files.
EVERY = 0.5
#: Seconds without a change after which a track is reported as quiet.
QUIET = 20.0
WAITING, RUNNING, FINISHED = "waiting", "running", "finished"
_NOW, _KEYFRAMES, _POINTS = (230, 60, 40), (120, 126, 134), (96, 104, 116)
_PATH, _LINES = np.array([40, 110, 220], np.uint8), np.array([20, 130, 90], np.uint8)
_MAX_CAMERAS = 200
#: What can be switched off.
_SWITCHES = ("path", "keyframes", "points", "lines", "planes")


class LiveView:
    """The files of a track so far, on a server.

    Parameters
    ----------
    server : viser.ViserServer
        Where to draw. It is not stopped here.
    output : path
        The folder that ``groma track -o`` was given.
    """

    def __init__(self, server: viser.ViserServer, output: Path) -> None:
        self.server = server
        self._output, self._work = output, output.with_name(output.name + ".work")
        self._seen: dict[Path, float] = {}
        self._placed = False
        self._size = 1.0
        self._nodes: dict[str, list[Any]] = {}
        #: ``waiting``, ``running`` or ``finished``.
        self.state = WAITING
        self.num_frames = 0
        self.scene: Scene | None = None
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        server.gui.set_panel_label(f"groma: {output.absolute().name}")
        server.gui.main_panel.dock_right()
        # The world is the first camera, whose y points down.
        server.scene.set_up_direction("-y")
        keep_cameras(server)
        self.statuses: Statuses | None = None
        self._path = np.zeros((0, 7))
        self._words = server.gui.add_markdown("")
        self._add_panel()
        self._say()

    def _add_panel(self) -> None:
        gui = self.server.gui
        self.picture = gui.add_image(
            np.full((3, 4, 3), 40, np.uint8), label="Latest frame", format="jpeg", visible=False
        )
        self.timeline = gui.add_html("", visible=False)
        self.frame_shown = gui.add_slider("Frame", min=1, max=2, step=1, initial_value=2, visible=False)
        self.frame_shown.hint = "Where the camera was; at the right end, where it is."
        self.frame_shown.on_update(lambda _: self._draw_now())
        with gui.add_folder("Show"):
            self.shown = {name: gui.add_checkbox(name.capitalize(), True) for name in _SWITCHES}
        for name, box in self.shown.items():
            box.on_update(lambda _, name=name: self._switch(name))
        self.follow = gui.add_checkbox("Follow the camera", False)
        self.follow.hint = "Keep the camera of the track in the middle of the view."

    def _switch(self, name: str) -> None:
        """Show or hide all nodes of a kind."""
        for node in self._nodes.get(name, []):
            node.visible = self.shown[name].value

    def refresh(self) -> bool:
        """Read changed files, draw them, and return whether there were any."""
        running = self._work.is_dir()
        if not running and not (self._output / "scene.npz").exists():
            changed = self.state != WAITING
            self.state = WAITING
        else:
            folder = self._work if running else self._output
            state = RUNNING if running else FINISHED
            changed = state != self.state
            self.state = state
            for name, show in self._files(running).items():
                # A file that does not exist yet, or is being replaced, is read later.
                with contextlib.suppress(GromaError, OSError, ValueError):
                    if self._is_new(folder / name):
                        show(folder / name)
                        changed = True
        self._say()
        return changed

    def _files(self, running: bool) -> dict[str, Callable[[Path], None]]:
        """Return the function that draws each file, by name; the scene first, whose size is that of the cameras."""
        scene: dict[str, Callable[[Path], None]] = {"scene.npz": lambda path: self._draw_scene(read_scene(path))}
        if not running:
            return {**scene, "trajectory.txt": lambda path: self._draw_path(read_tum(path).world_from_cam)}
        return {
            **scene,
            "frames.txt": lambda path: self._draw_path(read_frames(path)),
            "statuses.txt": lambda path: self._show_statuses(read_statuses(path)),
            "now.npz": lambda path: self._show_picture(read_now(path)),
        }

    def _is_new(self, path: Path) -> bool:
        stamp = path.stat().st_mtime_ns
        if self._seen.get(path) == stamp:
            return False
        self._seen[path] = stamp
        return True

    def _show_picture(self, picture: Picture) -> None:
        self.picture.image = picture
        self.picture.visible = True

    def _show_statuses(self, statuses: Statuses) -> None:
        self.statuses = statuses
        self.timeline.content = timeline(statuses)
        self.timeline.visible = len(statuses) > 0

    def _draw_path(self, world_from_cam: FloatArray) -> None:
        at_end = self.frame_shown.value >= self.frame_shown.max
        self._path, self.num_frames = world_from_cam, len(world_from_cam)
        if not self.num_frames:
            return
        self.frame_shown.max = max(self.num_frames, 2)
        self.frame_shown.visible = self.num_frames > 2
        if at_end or self.frame_shown.value > self.frame_shown.max:
            self.frame_shown.value = self.frame_shown.max
        centers = world_from_cam[:, 4:]
        if len(centers) > 1:
            pieces = np.stack([centers[:-1], centers[1:]], axis=1)
            visible = self.shown["path"].value
            self._nodes["path"] = [_view_arrays.add_segments(self.server, "/path", pieces, _PATH, 3.0, visible)]
        self._draw_now()

    def _draw_now(self) -> None:
        """Draw the camera of the selected frame; move the view along if it is followed."""
        if not len(self._path):
            return
        pose = self._path[min(int(self.frame_shown.value), len(self._path)) - 1]
        self._now = self._camera("/now", pose, _NOW, 1.5)
        if self.follow.value:
            for client in self.server.get_clients().values():
                with client.atomic():
                    client.camera.position = client.camera.position + pose[4:] - client.camera.look_at
                    client.camera.look_at = pose[4:]

    def _draw_scene(self, scene: Scene) -> None:
        self.scene = scene
        world = se3.inverse(scene.cam_from_world)
        places = np.concatenate([scene.points.xyz, scene.lines.segments.reshape(-1, 3), world[:, 4:]])
        if not len(places):
            return
        low, high = np.percentile(places, [10, 90], axis=0)
        self._size = max(float(np.linalg.norm(high - low)), 1e-3)
        shown, nodes = {name: box.value for name, box in self.shown.items()}, self._nodes
        with self.server.atomic():
            colour, size = np.array(_POINTS, np.uint8), 0.004 * self._size
            nodes["points"] = [
                _view_arrays.add_dots(self.server, "/points", scene.points.xyz, colour, size, shown["points"])
            ]
            self.server.scene.remove_by_name("/lines")
            nodes["lines"] = []
            if scene.num_lines:
                # In a growing map the heaviest directions may change places.
                hues = of_lines(scene) if self.state == FINISHED else _LINES
                lines = _view_arrays.add_segments(
                    self.server, "/lines", scene.lines.segments, hues, 2.0, shown["lines"]
                )
                nodes["lines"].append(lines)
            self.server.scene.remove_by_name("/keyframes")
            nodes["keyframes"] = [
                self._camera(f"/keyframes/{row}", world[row], _KEYFRAMES, 1.0, shown["keyframes"])
                for row in thin(len(world), _MAX_CAMERAS)
            ]
            self.server.scene.remove_by_name("/planes")
            nodes["planes"] = _view_arrays.add_patches(self.server, "/planes", *plane_patches(scene), shown["planes"])
        if not self._placed:
            self._placed = True
            self._look_at(0.5 * (low + high))

    def _camera(
        self, name: str, world_from_cam: FloatArray, colour: tuple[int, int, int], size: float, visible: bool = True
    ) -> viser.CameraFrustumHandle:
        scene = self.scene
        opening, aspect = 0.8, 4.0 / 3.0
        if scene is not None and len(scene.cameras.width):
            width, height = float(scene.cameras.width[0]), float(scene.cameras.height[0])
            opening, aspect = 2.0 * float(np.arctan2(0.5 * height, scene.cameras.params[0][1])), width / height
        return self.server.scene.add_camera_frustum(
            name, fov=opening, aspect=aspect, scale=0.03 * size * self._size, color=colour,
            thickness=1.5, thickness_units="screen",
            wxyz=quaternion.to_wxyz(world_from_cam[:4]), position=world_from_cam[4:],
            cast_shadow=False, receive_shadow=False, visible=visible,
        )  # fmt: skip

    def _look_at(self, middle: FloatArray) -> None:
        """Move the view of all pages above and behind the first camera."""
        start = middle + self._size * np.array([0.0, -0.8, -1.3])
        self.server.initial_camera.position, self.server.initial_camera.look_at = start, middle
        for client in self.server.get_clients().values():
            with client.atomic():
                client.camera.position, client.camera.look_at = start, middle

    def _say(self) -> None:
        lines = {
            WAITING: f"Waiting for `groma track -o {self._output.name}` to begin.",
            RUNNING: "**Running.**",
            FINISHED: "**Finished.** This is the adjusted result.",
        }[self.state]
        if self.state == RUNNING and self._seen:
            silence = time.time() - max(self._seen.values()) * 1e-9
            if silence > QUIET:
                lines = f"**Nothing new for {duration(silence)}.** The track may have been stopped."
        if self.statuses is not None and len(self.statuses) and self.state == RUNNING:
            lines += f"\n\n{self.statuses.sentence()}"
        if self.scene is not None:
            scene = self.scene
            lines += f"\n\n{counted(self.num_frames, 'frames')}, {counted(scene.num_images, 'keyframes')}\n\n"
            lines += ", ".join(counted(getattr(scene, f"num_{kind}"), kind) for kind in ("points", "lines", "planes"))
        if self._words.content != lines:
            self._words.content = lines


def read_frames(path: Path) -> FloatArray:
    """Poses (n, 7) world_from_cam of the frames of the current submap, from complete rows."""
    with reading(path, "list of frames"):
        rows = [(line, words) for line, words in read_words(path) if len(words) == 9]
        table = np.array([finite(words, f"{path}, line {line}") for line, words in rows]).reshape(-1, 9)
    return np.hstack([table[:, 4:8], table[:, 1:4]])[table[:, 8] == (table[-1, 8] if len(table) else 0)]


@contextlib.contextmanager
def following(output: Path, port: int = 8080, say: Say | None = None) -> Iterator[LiveView]:
    """Serve a running track inside a ``with`` block; call :meth:`LiveView.refresh` now and then."""
    server = start_server("127.0.0.1", port, say)
    try:
        yield LiveView(server, output)
    finally:
        stop_server(server)
