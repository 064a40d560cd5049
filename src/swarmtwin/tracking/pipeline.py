"""Which code each stage of `dvc.yaml` computes with, followed from its command through imports.

The stage `code` writes it (`python -m swarmtwin.tracking.pipeline ROBOT OUTPUT DIGEST`): for every stage of the robot a
file `artifacts/code/<robot>/<stage>`, with the digests of what the code does (`bare_code.py`) that it computes with. It
hangs on all code and the others on that file, so that `dvc repro` always looks at the code first. Each robot has its
own, as DVC refuses to look after what another process's stage is reading. It cannot hang on `dvc.yaml` itself, so the
digest of what stands there is part of its command: `make dependencies` (no arguments) writes that; a test compares.
The module is in `tracking/` because it answers the question of that room, what a result came from; it reads the other
rooms as text and imports none of them.

A stage hangs on the module of its command, on whatever that imports, wherever in the file the import stands, and

- of plug-ins, on those that its configuration chooses: a stage with `model=crnet` hangs on `dynamics/models/crnet.py`
  and not on `gru.py`. Where it chooses none, on those that the stages chose whose outputs it reads; where neither does,
  or where it reads what several of them left, on the whole folder.
- on what draws, the modules of `DRAWING`, only where drawing is its task: all others leave results that a drawing
  stage is made from, so a line in a plot makes no result stale.
"""

import hashlib
import json
import re
import sys
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from swarmtwin.tracking.bare_code import digest
from swarmtwin.tracking.imports import Code, PluginKind, matches
from swarmtwin.tracking.stages import read_stages

DRAWING = ("*_plots.py", "plotting.py", "progress_bars.py", "report/*", "rendering/*", "pictures/*")
"""Files that only draw, print or lay out what other modules have computed, as patterns of their paths' ends."""


class Pipeline:
    """A repository's `dvc.yaml`, its configuration and its code, as they are when they are first asked for.

    Attributes:
        repository: its folder.
        stages: by name.
    """

    def __init__(self, repository: Path) -> None:
        self.repository = repository
        self.stages = read_stages(repository)
        self._configurations: dict[str, dict[str, Any]] = {}

    @cached_property
    def source(self) -> Code:
        """Its code."""
        return Code(self.repository / "src")

    def is_drawing(self, name: str) -> bool:
        """Say whether a stage draws what others have computed."""
        return matches(self.source.paths[self.stages[name].module], DRAWING)

    @cached_property
    def choices(self) -> dict[str, dict[str, set[str]]]:
        """The files in `conf/` that each stage's configuration is composed of, by their folder.

        They are those in the defaults list that its command begins with, as Hydra reads it, unless an option names
        another.
        """
        found: dict[str, dict[str, set[str]]] = {name: {} for name in self.stages}
        for name, stage in self.stages.items():
            for entry in self._configuration(stage.config_name)["defaults"]:
                (group, choice), *_ = entry.items() if isinstance(entry, dict) else [("", None)]
                group = group.removeprefix("/")
                choice = stage.options.get(group, choice)
                if choice is not None and not group.startswith("override "):
                    found[name].setdefault(group.partition("@")[0], set()).add(choice)
        return found

    def _configuration(self, name: str) -> dict[str, Any]:
        if name not in self._configurations:
            self._configurations[name] = yaml.safe_load((self.repository / "conf" / f"{name}.yaml").read_text())
        return self._configurations[name]

    @cached_property
    def code(self) -> dict[str, set[Path]]:
        """The files of code that each stage hangs on, relative to the repository."""
        kinds = {kind for kinds in self.source.plugin_kinds.values() for kind in kinds}
        own = {kind: self._chosen_plugins(kind) for kind in kinds}
        return {
            name: self.source.reached(
                stage.module,
                {kind: names for kind in kinds if (names := self._followed_plugins(name, own[kind]))},
                leave_out=() if self.is_drawing(name) else DRAWING,
            )
            for name, stage in self.stages.items()
        }

    def _chosen_plugins(self, kind: PluginKind) -> dict[str, set[str]]:
        """Return the plug-ins of a kind that the configuration of each stage chooses."""
        return {
            name: {
                self._configuration(f"{kind.group}/{file}")[kind.field] for file in choices.get(kind.group or "", ())
            }
            for name, choices in self.choices.items()
        }

    def _followed_plugins(self, name: str, chosen: Mapping[str, set[str]]) -> list[str]:
        """Return a stage's own plug-ins or those of the stages that it reads; none where they are not to be told."""
        if chosen[name]:
            return sorted(chosen[name])
        by_template: dict[str, set[str]] = {}
        for other in self.stages[name].upstream:
            by_template.setdefault(self.stages[other].template, set()).update(chosen[other])
        several = any(len(names) > 1 for names in by_template.values())
        return [] if several else sorted(set().union(*by_template.values()))

    def write_code(self, robot: str, output: Path) -> None:
        """Write for each stage of a robot a file with the code that it hangs on: `<digest>  <path>` in each line."""
        output.mkdir(parents=True, exist_ok=True)
        stages = [stage for stage in self.stages.values() if stage.items["robot"] == robot]
        files = sorted(set().union(*(self.code[stage.name] for stage in stages)))
        lines = {file: f"{digest(self.repository / file)}  {file.as_posix()}\n" for file in files}
        for stage in stages:
            text = "".join(lines[file] for file in files if file in self.code[stage.name])
            (output / stage.code_file).write_text(text)


def with_digest(text: str) -> str:
    """Return the text of a `dvc.yaml` in which the digest of its stages is that of those that stand there."""
    stages = json.dumps(yaml.safe_load(text)["stages"], sort_keys=True)
    return re.sub(r"(- digest_of_stages: )\w+", rf"\g<1>{hashlib.sha256(stages.encode()).hexdigest()[:16]}", text)


if __name__ == "__main__":
    if sys.argv[1:]:
        Pipeline(Path.cwd()).write_code(sys.argv[1], Path(sys.argv[2]))
    else:
        Path("dvc.yaml").write_text(with_digest(Path("dvc.yaml").read_text()))
