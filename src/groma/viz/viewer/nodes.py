# SPDX-License-Identifier: BSD-3-Clause
"""A scene on a viser server: the nodes of the page, its panel, and their callbacks."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from groma._typing import BoolArray
from groma.scene.patches import patch_groups
from groma.viz import colours as _colours
from groma.viz import framing
from groma.viz.pack import thin
from groma.viz.pictures import ImageFiles, image_file, read_picture, warn_of_names_outside
from groma.viz.viewer import arrays as _view_arrays
from groma.viz.viewer import messages as _view_words
from groma.viz.viewer.content import LINE_MODES, REACH, ViewContent
from groma.viz.viewer.server import keep_cameras

if TYPE_CHECKING:
    import viser

#: Points drawn at first; a slider changes the number.
FIRST_POINTS = 100_000
#: Maximum number of drawn cameras, each an object of the page; of more, an even choice.
MAX_CAMERAS = 400
#: Longer side of the photographs in the cameras, pixels.
THUMBNAIL = 256
#: Vertical opening of the page, radians.
OPENING = float(2.0 * np.arctan(framing.OPENING[1]))
#: A click this near to a line hits it, pixels.
CLICK_PIXELS = 8.0

_ORANGE = (255, 150, 30)
#: Cameras: where there are few, and where there are many.
_CAMERA = (60, 66, 74)
_CAMERAS = (150, 156, 164)
_MANY_CAMERAS = 100
#: Colour of junctions, and their size over that of the scene.
_JUNCTION, _JUNCTION_SIZE = (200, 40, 120), 0.008
#: Width of the panel beside the scene, pixels; in windows that are higher than wide it lies over it.
_PANEL = 320
#: What is shown on request.
_OFF_AT_FIRST = ("directions", "junctions")


class SceneView:
    """A scene on a server: its nodes and its panel.

    Parameters
    ----------
    server : viser.ViserServer
        Where to draw. It is not stopped here.
    content : ViewContent
        What to draw.
    images : path or mapping, optional
        Folder of the photographs, or files by image name.
    """

    def __init__(self, server: viser.ViserServer, content: ViewContent, images: ImageFiles | None = None) -> None:
        self.server = server
        self.content = content
        self.images = images
        #: The clicked line, or None.
        self.selected: int | None = None
        #: Number of drawn cameras that have a photograph.
        self.num_pictures = 0
        self._lock = threading.RLock()
        self._nodes: dict[str, list[Any]] = {"cameras": [], "planes": [], "directions": [], "junctions": []}
        self._drawn_points: tuple[int, str] | None = None
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        server.gui.set_panel_label("groma")
        server.gui.main_panel.dock_right()
        server.scene.set_up_direction("+z")
        server.initial_camera.fov = OPENING
        server.initial_camera.position = content.start_position
        server.initial_camera.look_at = np.zeros(3)
        with server.atomic():
            self._add_panel()
            self._add_cameras()
            self._add_planes()
            self._add_directions()
            self._add_junctions()
            self.draw_points()
            self.draw_lines()
        server.scene.on_click()(self._clicked)
        keep_cameras(server, self._look_from_outside)

    # ------------------------------------------------------------------------------------------------------- Panel

    def _add_panel(self) -> None:
        gui, content, scene = self.server.gui, self.content, self.content.scene
        count = len(content.points)
        gui.add_markdown(_view_words.counts(scene, MAX_CAMERAS))
        with gui.add_folder("Show"):
            kinds = {
                "cameras": scene.num_images,
                "photographs": scene.num_images if self.images is not None else 0,
                "points": count,
                "lines": scene.num_lines,
                "planes": scene.num_planes,
                "directions": scene.num_directions,
                "junctions": len(content.junctions),
            }
            self.shown = {
                name: gui.add_checkbox(name.capitalize(), name not in _OFF_AT_FIRST, visible=number > 0)
                for name, number in kinds.items()
            }
        with gui.add_folder("Lines", visible=scene.num_lines > 0):
            self.line_mode = gui.add_dropdown("Colour", LINE_MODES, initial_value="direction")
            self.legend = gui.add_html("")
            self.line_width = gui.add_slider("Width", min=1.0, max=8.0, step=0.5, initial_value=2.0)
            most = int(content.statistics.num_images.max(initial=1))
            self.min_images = gui.add_slider("In images", min=0, max=max(most, 1), step=1, initial_value=0)
            self.min_images.hint = "Show lines observed in at least so many images."
        self.selection = gui.add_html(_view_words.note(_view_words.HINT), visible=scene.num_lines > 0)
        with gui.add_folder("Points", visible=count > 0):
            modes = tuple(content.point_colours)
            self.point_mode = gui.add_dropdown("Colour", modes, initial_value=modes[0])
            size = _view_arrays.point_size(count)
            self.point_size = gui.add_slider("Size", min=1.0, max=20.0, step=0.5, initial_value=size)
            first = min(count, FIRST_POINTS)
            step = max(1, count // 100)
            self.point_count = gui.add_slider("Number", min=0, max=max(count, 1), step=step, initial_value=first)
        with gui.add_folder("Cameras", visible=scene.num_images > 0):
            self.camera_size = gui.add_slider("Size", min=0.1, max=4.0, step=0.1, initial_value=1.0)
            names = [f"{index + 1}: {name}" for index, name in enumerate(scene.images.names)]
            self.look_from = gui.add_dropdown("Look from", ("outside", *names))
        for name, checkbox in self.shown.items():
            checkbox.on_update(self._on_toggle(name))
        for control in (self.line_mode, self.min_images):
            control.on_update(lambda _: self.draw_lines())
        self.line_width.on_update(lambda _: setattr(self.lines, "thickness", self.line_width.value))
        for control in (self.point_mode, self.point_count):
            control.on_update(lambda _: self.draw_points())
        self.point_size.on_update(lambda _: setattr(self.points, "point_size", self._point_size()))
        self.camera_size.on_update(lambda _: self._resize_cameras())
        self.look_from.on_update(self._move_to_camera)

    def _on_toggle(self, name: str) -> Callable[[Any], None]:
        def toggle(_: Any) -> None:
            visible = self.shown[name].value
            if name == "points":
                self.points.visible = visible
            elif name == "lines":
                self.lines.visible = visible
                self._clear_selection()
            elif name == "photographs":
                with self._lock, self.server.atomic():
                    for node, picture in zip(self._nodes["cameras"], self._pictures, strict=True):
                        node.image = picture if visible else None
            else:
                for node in self._nodes[name]:
                    node.visible = visible

        return toggle

    # ------------------------------------------------------------------------------------------------------- Nodes

    def draw_points(self) -> None:
        """Draw the points by the settings of the panel."""
        with self._lock:
            # The slider may have moved during an earlier call.
            wanted = int(self.point_count.value), self.point_mode.value
            if wanted == self._drawn_points:
                return
            self._drawn_points = wanted
            number, mode = wanted
            places, colours = self.content.points[:number], self.content.point_colours[mode][:number]
            self.points = _view_arrays.add_dots(
                self.server, "/points", places, colours, self._point_size(), self.shown["points"].value
            )

    def draw_lines(self) -> None:
        """Draw the lines by the settings of the panel."""
        with self._lock:
            found = self.content.line_colours(self.line_mode.value)
            kept, line = self.lines_shown(), self.content.segment_line
            drawn = kept[line]
            self.legend.content = _view_words.legend(found.low, found.high, found.meaning, int(kept.sum()), len(kept))
            segments, colours = self.content.segments[drawn], found.colours[line[drawn]]
            self.lines = _view_arrays.add_segments(
                self.server, "/lines", segments, colours, self.line_width.value, self.shown["lines"].value
            )

    def lines_shown(self) -> BoolArray:
        """(L,) which lines are drawn."""
        return self.content.statistics.num_images >= self.min_images.value

    def _add_cameras(self) -> None:
        content = self.content
        self._camera_images = thin(content.scene.num_images, MAX_CAMERAS)
        self._pictures: list[Any] = []
        many = len(self._camera_images) > _MANY_CAMERAS
        self._camera_scale = _view_arrays.camera_scale(content.camera_centers)
        warn_of_names_outside(self.images, content.scene.images.names)
        for image in self._camera_images:
            path = image_file(self.images, content.scene.images.names[image])
            picture = read_picture(path, THUMBNAIL) if path is not None else None
            self._pictures.append(picture)
            self.num_pictures += picture is not None
            self._nodes["cameras"].append(
                self.server.scene.add_camera_frustum(
                    f"/cameras/{image}",
                    fov=float(content.camera_openings[image]),
                    aspect=float(content.camera_aspects[image]),
                    scale=self._camera_scale,
                    thickness=1.0 if many else 1.5,
                    thickness_units="screen",
                    color=_CAMERAS if many else _CAMERA,
                    image=picture,
                    format="jpeg",
                    jpeg_quality=80,
                    wxyz=content.camera_wxyz[image],
                    position=content.camera_centers[image],
                    cast_shadow=False,
                    receive_shadow=False,
                )
            )

    def _resize_cameras(self) -> None:
        with self.server.atomic():
            for node in self._nodes["cameras"]:
                node.scale = self._camera_scale * self.camera_size.value

    def _add_planes(self) -> None:
        """Draw the planes, filled and with their edges."""
        patches = self.content.patches
        if not patches:
            return
        self._nodes["planes"] += _view_arrays.add_patches(
            self.server, "/planes/faces", patches, self.content.patch_members
        )
        edges = [np.stack([corners, np.roll(corners, -1, axis=0)], axis=1) for corners in patches]
        colours = _colours.PALETTE[patch_groups(self.content.patch_members)]
        colours = np.repeat(colours, [len(edge) for edge in edges], axis=0)
        self._nodes["planes"].append(
            _view_arrays.add_segments(self.server, "/planes/edges", np.concatenate(edges), colours, 1.5)
        )

    def _add_directions(self) -> None:
        """A bar through the middle of the scene for each direction, the longer the more lines follow it."""
        vectors, members = self.content.directions, self.content.direction_members
        if not len(vectors):
            return
        length = REACH * (0.25 + 0.75 * np.sqrt(members / max(members.max(), 1)))
        bars = np.stack([-vectors, vectors], axis=1) * length[:, None, None]
        colours = _colours.of_group(np.arange(len(vectors)))
        self._nodes["directions"].append(
            _view_arrays.add_segments(self.server, "/directions", bars, colours, 5.0, visible=False)
        )

    def _add_junctions(self) -> None:
        """A dot where two lines meet."""
        places = self.content.junctions
        if len(places):
            colour, size = np.array(_JUNCTION, np.uint8), _JUNCTION_SIZE * REACH
            self._nodes["junctions"].append(
                _view_arrays.add_dots(self.server, "/junctions", places, colour, size, False, "diamond")
            )

    def _point_size(self) -> float:
        return 0.0005 * REACH * self.point_size.value

    # --------------------------------------------------------------------------------------------------- Selection

    def _clicked(self, event: Any) -> None:
        if not self.shown["lines"].value:
            return
        camera = event.client.camera
        height = camera.image_height or 800
        tolerance = CLICK_PIXELS * 2.0 * np.tan(0.5 * camera.fov) / height
        hit = self.content.pick(
            np.asarray(event.ray_origin), np.asarray(event.ray_direction), tolerance, self.lines_shown()
        )
        self.select(hit)

    def select(self, line: int | None) -> None:
        """Mark a line, join it to the cameras that observe it, and list its observations; None marks nothing."""
        with self._lock:
            self._clear_selection()
            if line is None:
                return
            self.selected = line
            content, seen = self.content, self.content.scene.line_observations
            rows = np.flatnonzero(seen.line_idx == line)
            pieces = content.segments[content.segment_line == line]
            images = np.unique(seen.image_idx[rows])
            met = np.isin(content.segment_line, content.lines_met(line))
            rays = np.stack(
                [content.camera_centers[images], np.broadcast_to(pieces.mean(axis=(0, 1)), (len(images), 3))], axis=1
            )
            with self.server.atomic():
                for name, places, width, colour in (
                    ("line", pieces, self.line_width.value + 5.0, _ORANGE),
                    ("rays", rays, 1.0, _ORANGE),
                    ("met", content.segments[met], self.line_width.value + 2.0, _JUNCTION),
                ):
                    if len(places):
                        self.server.scene.add_line_segments(
                            f"/selection/{name}",
                            places.astype(np.float32),
                            colour,
                            thickness=width,
                            thickness_units="screen",
                        )
                self.selection.content = _view_words.describe_line(content, line, self.images)

    def _clear_selection(self) -> None:
        with self._lock:
            if self.selected is None:
                return
            self.selected = None
            self.server.scene.remove_by_name("/selection")
            self.selection.content = _view_words.note(_view_words.HINT)

    def _look_from_outside(self, client: Any) -> None:
        """Move the view to where it begins; farther away in a window that is less wide than the view expects."""
        camera = client.camera
        wide = camera.image_width - (_PANEL if camera.image_width > camera.image_height else 0)
        away = max(1.0, framing.OPENING[0] / framing.OPENING[1] * camera.image_height / wide)
        camera.position, camera.look_at = away * self.content.start_position, np.zeros(3)

    def _move_to_camera(self, event: Any) -> None:
        """Move the view to the pose of a photograph, or back."""
        if event.client is None:
            return
        image = self.look_from.options.index(self.look_from.value) - 1
        camera = event.client.camera
        # Photographs would cover the view from there.
        self.shown["cameras"].value = image < 0
        with event.client.atomic():
            if image < 0:
                self._look_from_outside(event.client)
                camera.up_direction, camera.fov = np.array([0.0, 0.0, 1.0]), OPENING
            else:
                camera.wxyz, opening = self.content.upright_from(image)
                camera.position = self.content.camera_centers[image]
                camera.fov = float(np.clip(opening, 0.2, 2.0))
