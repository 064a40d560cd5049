"""The overhead picture that the page shows: the camera's, brought into the arena's frame, with what control knows."""

from collections import deque
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from swarmtwin.deploy.live_view.view_process import Scene

INK, PAPER, GROUND, FENCE, TARGET, ALARM, OBSTACLE = (
    (60, 55, 50),
    (243, 246, 246),
    (255, 255, 255),
    (120, 110, 100),
    (99, 143, 63),
    (60, 60, 205),
    (166, 153, 141),
)


class Overlay:
    """Draws pictures of one scene; remembers where vehicles have been.

    Attributes:
        size: width and height of its pictures, px.
    """

    def __init__(self, scene: Scene, longest_px: int = 760, outside_share: float = 0.04, trail: int = 240) -> None:
        self.scene = scene
        low, high = np.array(scene.arena_mm[:2]), np.array(scene.arena_mm[2:])
        outside_mm = outside_share * float((high - low).max())
        self._low_mm, self._high_mm = low - outside_mm, high + outside_mm
        self._scale = longest_px / float((self._high_mm - self._low_mm).max())
        width, height = np.ceil((self._high_mm - self._low_mm) * self._scale).astype(int)
        self.size = int(width), int(height)
        self._trails: dict[str, deque[tuple[float, float]]] = {one: deque(maxlen=trail) for one in scene.vehicles}
        self._warp: np.ndarray | None = None
        if scene.corners_px is not None:
            corners_mm = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
            corners = np.asarray(scene.corners_px, np.float32)
            self._warp = cv2.getPerspectiveTransform(corners, self._px(corners_mm).astype(np.float32))

    def draw(
        self, image: np.ndarray | None, poses: Mapping[str, list[float]], age_s: float, state: Mapping[str, Any]
    ) -> np.ndarray:
        """Return a picture (H, W, 3), blue, green, red.

        Args:
            image: the camera's; None: a blank ground.
            poses: (3,) of the vehicles that were seen on it.
            age_s: of the picture.
            state: what control has published last.
        """
        canvas = self._ground(image)
        self._draw_fence(canvas)
        self._draw_task(canvas, state)
        known: Mapping[str, Any] = state.get("vehicles", {})
        for index, vehicle in enumerate(self.scene.vehicles):
            colour = _bgr(self.scene.colours[index % len(self.scene.colours)])
            pose = poses.get(vehicle)
            if pose is not None:
                self._trails[vehicle].append((pose[0], pose[1]))
            self._draw_trail(canvas, vehicle, colour)
            about = known.get(vehicle, {})
            last = pose if pose is not None else about.get("pose")
            if last is not None:
                self._draw_vehicle(canvas, vehicle, last, colour, about, is_seen=pose is not None and age_s < 1.0)
        return canvas

    def _px(self, position_mm: np.ndarray) -> np.ndarray:
        """Return pixels (..., 2) of positions (..., 2)."""
        away = np.asarray(position_mm, float)[..., :2] - self._low_mm
        return np.stack([away[..., 0], (self._high_mm - self._low_mm)[1] - away[..., 1]], axis=-1) * self._scale

    def _ground(self, image: np.ndarray | None) -> np.ndarray:
        width, height = self.size
        if image is None or self._warp is None:
            canvas = np.full((height, width, 3), PAPER, np.uint8)
            low, high = self._px(np.array([self.scene.arena_mm[:2], self.scene.arena_mm[2:]])).round().astype(int)
            cv2.rectangle(canvas, tuple(map(int, low)), tuple(map(int, high)), GROUND, -1)
            return canvas
        straight = cv2.warpPerspective(image, self._warp, (width, height), borderValue=PAPER)
        colour = straight if straight.ndim == 3 else cv2.cvtColor(straight, cv2.COLOR_GRAY2BGR)
        return np.asarray(cv2.addWeighted(colour, 0.72, np.full_like(colour, 255), 0.28, 0))

    def _draw_fence(self, canvas: np.ndarray) -> None:
        corners = self._px(np.array([self.scene.arena_mm[:2], self.scene.arena_mm[2:]])).round().astype(int)
        cv2.rectangle(canvas, tuple(map(int, corners[0])), tuple(map(int, corners[1])), FENCE, 2, cv2.LINE_AA)

    def _draw_task(self, canvas: np.ndarray, state: Mapping[str, Any]) -> None:
        for target in state.get("targets_mm", []):
            centre = tuple(map(int, self._px(np.array(target)).round()))
            radius = round(state.get("reach_mm", 0) * self._scale)
            shade = canvas.copy()
            cv2.circle(shade, centre, radius, TARGET, -1, cv2.LINE_AA)
            cv2.addWeighted(shade, 0.12, canvas, 0.88, 0, dst=canvas)
            cv2.circle(canvas, centre, radius, TARGET, 2, cv2.LINE_AA)
            cv2.drawMarker(canvas, centre, TARGET, cv2.MARKER_CROSS, 18, 2, cv2.LINE_AA)
        for x_mm, y_mm, radius_mm in state.get("obstacles", []):
            centre = tuple(map(int, self._px(np.array([x_mm, y_mm])).round()))
            cv2.circle(canvas, centre, round(radius_mm * self._scale), OBSTACLE, -1, cv2.LINE_AA)

    def _draw_trail(self, canvas: np.ndarray, vehicle: str, colour: tuple[int, ...]) -> None:
        trail = self._trails[vehicle]
        if len(trail) > 1:
            points = self._px(np.array(trail)).round().astype(np.int32)
            cv2.polylines(canvas, [points.reshape(-1, 1, 2)], False, colour, 2, cv2.LINE_AA)

    def _draw_vehicle(
        self,
        canvas: np.ndarray,
        vehicle: str,
        pose: list[float],
        colour: tuple[int, ...],
        about: Mapping[str, Any],
        is_seen: bool,
    ) -> None:
        """Draw the outline with a mark in front and the id; red and thick under alarm, grey where it is not seen."""
        length, width = (side * self._scale for side in self.scene.vehicle_size_mm)
        centre = self._px(np.array(pose[:2]))
        box = cv2.boxPoints((tuple(map(float, centre)), (length, width), -float(np.degrees(pose[2]))))
        alarm, held_back = bool(about.get("alarm")), about.get("scale", 1.0) < 1.0
        shown = colour if is_seen else (150, 150, 150)
        outline = [box.round().astype(np.int32)]
        shade = canvas.copy()
        cv2.fillPoly(shade, outline, shown, cv2.LINE_AA)
        cv2.addWeighted(shade, 0.45, canvas, 0.55, 0, dst=canvas)
        cv2.polylines(canvas, outline, True, ALARM if alarm else shown, 4 if alarm else 2, cv2.LINE_AA)
        if held_back:
            cv2.circle(canvas, tuple(map(int, centre.round())), round(0.75 * length), (40, 150, 235), 2, cv2.LINE_AA)
        ahead = centre + 0.75 * length * np.array([np.cos(pose[2]), -np.sin(pose[2])])
        start, end = (tuple(map(int, point.round())) for point in (centre, ahead))
        cv2.arrowedLine(canvas, start, end, ALARM if alarm else shown, 2, cv2.LINE_AA, tipLength=0.3)
        self._draw_label(canvas, vehicle, centre - np.array([0.0, 0.85 * length]), ALARM if alarm else shown)

    def _draw_label(self, canvas: np.ndarray, text: str, centre: np.ndarray, colour: tuple[int, ...]) -> None:
        (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 2)
        room = np.array(self.size) - (width / 2 + 8, height / 2 + 8)
        x, y = np.clip(centre, (width / 2 + 8, height / 2 + 8), room).round().astype(int)
        low, high = (x - width // 2 - 6, y - height // 2 - 5), (x + width // 2 + 6, y + height // 2 + 5)
        cv2.rectangle(canvas, tuple(map(int, low)), tuple(map(int, high)), colour, -1, cv2.LINE_AA)
        place = (int(x - width // 2), int(y + height // 2))
        cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.55, GROUND, 2, cv2.LINE_AA)


def _bgr(colour: str) -> tuple[int, ...]:
    return tuple(reversed(bytes.fromhex(colour.removeprefix("#"))))
