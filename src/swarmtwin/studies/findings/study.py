"""`swarmtwin experiment name=findings`: which of the paper's claims hold on our data, on one page.

Made of what the experiments on tables 1 to 4 and figures 7 to 13 left; nothing on it is typed.
"""

import json
import shutil
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from swarmtwin.files import new_folder, write_text
from swarmtwin.robot import StrictModel
from swarmtwin.studies.findings.collected import collect, floor_gains, paper_distances
from swarmtwin.studies.findings.page import page_text


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/findings.yaml."""

    name: Literal["findings"]
    folder: Path
    output: Path
    overwrite: bool


def run(options: Options) -> dict[str, Any]:
    """Write the page and copy its pictures beside it; return how many claims hold.

    Raises:
        UserError: there is no experiment's output in the folder, one is damaged, or the output is taken.
    """
    collected = collect(options.folder)
    gains, distances = floor_gains(collected), paper_distances(collected)
    settings = options.model_dump(mode="json")
    inputs = [one.folder for one in collected]
    with new_folder(options.output, "experiment", settings, options.overwrite, inputs=inputs) as folder:
        pictures: dict[str, str] = {}
        for one in collected:
            for picture in one.pictures:
                name = f"{one.folder.name}_{picture.name}"
                shutil.copyfile(picture, folder / name)
                pictures[name] = f"{one.summary.title}, {one.summary.robot}"
        text = page_text(collected, gains, distances, pictures)
        write_text(folder / "findings.md", text)
        metrics = {
            "claims": {one.folder.name: [claim.model_dump() for claim in one.summary.claims] for one in collected},
            "enough": {one.folder.name: [way.model_dump() for way in one.summary.enough] for one in collected},
            "floor_gains": [gain.model_dump() for gain in gains],
            "paper_distances": [distance.model_dump() for distance in distances],
        }
        write_text(folder / "metrics.json", json.dumps(metrics, indent=1) + "\n")
    Console().print(text.partition("\n![")[0], highlight=False, markup=False)
    Console().print(f"the same with pictures: {options.output / 'findings.md'}", highlight=False, soft_wrap=True)
    verdicts = [claim.judged.verdict for one in collected for claim in one.summary.claims]
    return {"claims_held": verdicts.count("holds"), "claims": len(verdicts), "output": str(options.output)}
