"""How far poses are from the truth, and what a table says of it."""

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from typing import Any

import cv2
import numpy as np
import pandas as pd

from swarmtwin.deploy.camera.camera import Frame
from swarmtwin.deploy.tracking.calibration import Lens
from swarmtwin.deploy.tracking.calibration_fit import MeasuredByHand, fit_calibration
from swarmtwin.deploy.tracking.tracker import Tracker
from swarmtwin.errors import UserError
from swarmtwin.geometry import wrap_angle
from swarmtwin.robot import Robot
from swarmtwin.studies.tracking.methods import Found, Method, corners_alone, homography, tracked
from swarmtwin.studies.tracking.scenes import Case, Hand, Scenes

COLUMNS = [
    "method",
    "seed",
    "picture",
    "vehicle",
    "x_mm",
    "y_mm",
    "heading_rad",
    "off_x_mm",
    "off_y_mm",
    "off_rad",
    "ms",
]


def measured_errors(
    robot: Robot, vehicles: tuple[str, ...], case: Case, seed: int, pictures: int, calibrated_on: int, hand: Hand
) -> tuple[pd.DataFrame, np.ndarray]:
    """Calibrate one camera, let every method look at its pictures, and compare with the truth.

    Returns:
        a row for each method, picture and vehicle: the truth, how far off the method is (NaN where it did not find the
        vehicle), and how long it took for the whole picture; and the first picture.
    """
    scenes = Scenes(robot, vehicles, case, seed, hand)
    methods = _methods(scenes, calibrated_on)
    rows: list[tuple[Any, ...]] = []
    first = None
    for number, scene in enumerate(scenes.draw(pictures)):
        first = scene.image if first is None else first
        for name, find in methods.items():
            begin_s = perf_counter()
            found = find(scene.image)
            elapsed_ms = (perf_counter() - begin_s) * 1000
            for index, vehicle in enumerate(vehicles):
                off = _off(found.get(vehicle), scene.pose[index])
                rows.append((name, seed, number, vehicle, *scene.pose[index], *off, elapsed_ms))
    assert first is not None
    return pd.DataFrame(rows, columns=COLUMNS), first


def following_ms(
    robot: Robot, vehicles: tuple[str, ...], case: Case, seed: int, pictures: int, fps: float = 30.0
) -> float:
    """Return the median time in ms that the tracker takes for a picture of vehicles that drive on from the last one."""
    scenes = Scenes(robot, vehicles, case, seed)
    tracker = Tracker(scenes.true_calibration(), robot, vehicles)
    (start,) = scenes.draw(1)
    rng, took_s = np.random.default_rng(seed), []
    step = robot.displacement_limit / robot.period_s / fps
    pose = start.pose
    for number in range(pictures):
        pose = pose + np.column_stack([step[0] * np.cos(pose[:, 2]), step[0] * np.sin(pose[:, 2]), 0 * pose[:, 2]])
        frame = Frame(number, number / fps, scenes.camera.render(pose, rng))
        begin_s = perf_counter()
        tracker.track(frame)
        took_s.append(perf_counter() - begin_s)
    return float(np.median(took_s) * 1000)


def summary(errors: pd.DataFrame, wrong_mm: float = 10.0) -> dict[str, float]:
    """Return what a method's rows say together: of one case, all seeds.

    `wrong_share` counts poses farther off than `wrong_mm`; they are errors like the others. `bias_mm` is the length of
    the mean error of a seed, in the seed in which it is largest: a camera hangs but once.
    """
    found = errors.dropna(subset=["off_x_mm"])
    off_mm = np.hypot(found.off_x_mm, found.off_y_mm)
    off_deg = np.rad2deg(found.off_rad)
    bias = found.groupby("seed")[["off_x_mm", "off_y_mm"]].mean()
    share = {"found_share": len(found) / len(errors), "wrong_share": float((off_mm > wrong_mm).sum() / len(errors))}
    if found.empty:
        return {"poses": len(errors), **share}
    return {
        "poses": len(errors),
        **share,
        "p50_mm": float(np.percentile(off_mm, 50)),
        "p99_mm": float(np.percentile(off_mm, 99)),
        "largest_mm": float(off_mm.max()),
        "bias_mm": float(np.hypot(bias.off_x_mm, bias.off_y_mm).max()),
        "p50_deg": float(np.percentile(off_deg.abs(), 50)),
        "p99_deg": float(np.percentile(off_deg.abs(), 99)),
        "bias_deg": float(abs(off_deg.mean())),
        "picture_ms": float(errors.groupby(["seed", "picture"]).ms.first().median()),
    }


def _methods(scenes: Scenes, calibrated_on: int) -> Mapping[Method, Callable[[np.ndarray], Found]]:
    robot, vehicles, true = scenes.robot, scenes.vehicles, scenes.true_calibration()
    pictures = scenes.for_calibration(calibrated_on)
    return {
        "tracker": _calibrated(scenes, pictures),
        "measured_height": _calibrated(scenes, pictures, by_hand=scenes.by_hand._replace(camera_above_mm=None)),
        "measured_place": _calibrated(scenes, pictures, by_hand=scenes.by_hand),
        "measured_lens": _calibrated(scenes, pictures, lens=true.lens),
        "perfect": tracked(true, robot, vehicles),
        "subpixel": corners_alone(true, robot, vehicles, cv2.aruco.CORNER_REFINE_SUBPIX),
        "contour": corners_alone(true, robot, vehicles, cv2.aruco.CORNER_REFINE_CONTOUR),
        "homography": homography(pictures, robot, vehicles),
    }


def _calibrated(
    scenes: Scenes,
    pictures: Sequence[np.ndarray],
    lens: Lens | None = None,
    by_hand: MeasuredByHand | None = None,
) -> Callable[[np.ndarray], Found]:
    """Return our tracker, calibrated on pictures; one that finds nothing where the calibration is refused."""
    try:
        calibration = fit_calibration(pictures, scenes.robot, lens=lens, by_hand=by_hand, settings=scenes.fit_settings)
    except UserError:
        return lambda image: {}
    return tracked(calibration, scenes.robot, scenes.vehicles)


def _off(pose: np.ndarray | None, true: np.ndarray) -> tuple[float, float, float]:
    if pose is None:
        return np.nan, np.nan, np.nan
    return pose[0] - true[0], pose[1] - true[1], float(wrap_angle(pose[2] - true[2]))
