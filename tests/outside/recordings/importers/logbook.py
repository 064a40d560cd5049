"""Logbooks: `log.csv` with a row for each period and vehicle, angles in degrees."""

from typing import Literal

import numpy as np
import pandas as pd

from swarmtwin.recordings.importer import ImporterConfig
from swarmtwin.recordings.recording import Header, Track


class Config(ImporterConfig):
    """`conf/source/logbook.yaml`."""

    name: Literal["logbook"] = "logbook"

    def read(self, folder, robot, vehicles, run_s):
        rows = pd.read_csv(folder / "log.csv", dtype={"who": str})
        rows["angle_rad"] = np.arctan2(np.sin(np.deg2rad(rows.angle_deg)), np.cos(np.deg2rad(rows.angle_deg)))
        tracks = []
        for (run, who), part in rows.groupby([(rows.seconds // run_s).astype(int) + 1, "who"]):
            command, pose = part[["l", "r"]].to_numpy(float), part[["x", "y", "angle_rad"]].to_numpy(float)
            tracks.append(Track(f"run_{run:04d}", who, part.seconds.to_numpy(), command, pose))
        names = tuple(sorted(rows.who.unique()))
        return Header(
            robot=robot.name, period_s=robot.period_s, arena_mm=robot.arena_mm, source="log", vehicles=names
        ), tracks
