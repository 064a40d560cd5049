"""Which code each stage of `dvc.yaml` computes with, followed from its command through imports.

`make dependencies` (`python -m swarmtwin.tracking.pipeline`) writes the `artifacts/code/...` lines of every stage's
`deps:`; a test compares. They stand for the files in `src/swarmtwin/`, of which the stage `code` writes what they do
(`bare_code.py`): it hangs on all of them and the others on it, so that `dvc repro` always looks at the code first. Each
robot has its own, as DVC refuses to look after what another process's stage is reading.
Folders of data and artifacts, and parameters, stand in `dvc.yaml` as they are written there by hand.
The module is in `tracking/` because it answers the question of that room, what a result came from; it reads the other
rooms as text and imports none of them.

A stage hangs on the module of its command, on whatever that imports, wherever in the file the import stands, and

- of plug-ins, on those that its configuration chooses: a stage with `model=crnet` hangs on `dynamics/models/crnet.py`
  and not on `gru.py`. Where it chooses none, on those that the stages chose whose outputs it reads; where neither does,
  or where it reads what several of them left, on the whole folder.
- on what draws, the modules of `DRAWING`, only where drawing is its task: all others leave results that a drawing
  stage is made from, so a line in a plot makes no result stale.
"""

import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from swarmtwin.tracking.imports import Code, PluginKind, matches
from swarmtwin.tracking.stages import Stage, read_stages

DRAWING = ("*_plots.py", "plotting.py", "progress_bars.py", "report/*", "rendering/*", "pictures/*")
"""Files that only draw, print or lay out what other modules have computed, as patterns of their paths' ends."""


class Pipeline:
    """A repository's `dvc.yaml`, its configuration and its code, as they are when they are first asked for.

    Attributes:
        repository: its folder.
        source: its code.
        stages: by name.
    """

    def __init__(self, repository: Path) -> None:
        self.repository = repository
        self.source = Code(repository / "src")
        self.stages = read_stages(repository)
        self._configurations: dict[str, dict[str, Any]] = {}

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

    def code_of_template(self, template: str) -> list[str]:
        """Return the lines of code in the `deps:` of a stage as `dvc.yaml` spells it, for all its items at once.

        A file that only some items hang on is told by the item's place in its name, `models/${item.model}.py`; where
        its name does not follow from the item, all hang on it. A folder stands for all that is in it.
        """
        stages = [stage for stage in self.stages.values() if stage.template == template]
        files = set().union(*(self.code[stage.name] for stage in stages))
        spelled = {file: self._spelled(file, stages) for file in files}
        whole = {file for file, text in spelled.items() if text == str(file)}
        paths = {*spelled.values()} - set(map(str, whole)) | set(map(str, self._folders(whole)))
        return sorted(path.replace("src/swarmtwin/", "artifacts/code/${item.robot}/", 1) for path in paths)

    def _spelled(self, file: Path, stages: Sequence[Stage]) -> str:
        """Return how the name of a file follows from the items of those stages that hang on it; else its name."""
        users = [stage for stage in stages if file in self.code[stage.name]]
        places = {place for stage in users for place, item in stage.items.items() if item == file.stem}
        for place in sorted(places) if len(users) < len(stages) else ():
            if all(file.with_stem(stage.items[place]) in self.code[stage.name] for stage in stages):
                return str(file.with_stem(f"${{item.{place}}}"))
        return str(file)

    def _folders(self, files: set[Path]) -> set[Path]:
        """Put a folder in the place of its files where all that it holds is among them."""
        whole: dict[Path, set[Path]] = {}
        for folder in sorted({parent for file in files for parent in file.parents if len(parent.parts) > 2}):
            held = (file.relative_to(self.repository) for file in (self.repository / folder).rglob("*.*"))
            inside = {file for file in held if "__pycache__" not in file.parts} - self.source.empty_files
            if inside <= files and not any(parent in whole for parent in folder.parents):
                whole[folder] = inside
        return (files - set().union(*whole.values())) | set(whole)


def with_dependencies(pipeline: Pipeline) -> str:
    """Return the text of a repository's `dvc.yaml` with the code that its stages hang on; the rest stays as it is."""
    lines, stage, indent = [], "", None
    for line in (pipeline.repository / "dvc.yaml").read_text().splitlines():
        if name := re.fullmatch(r"  (\w+):", line):
            stage = name[1]
        if indent is not None and not line.startswith(f"{indent}- "):
            lines += [f"{indent}- {path}" for path in pipeline.code_of_template(stage)]
            indent = None
        if indent is None or not line.startswith(f"{indent}- artifacts/code/"):
            lines.append(line)
        if found := re.fullmatch(r"( +)deps:", line):
            indent = f"{found[1]}  "
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the code that stages hang on into `dvc.yaml` in the current folder."""
    (Path.cwd() / "dvc.yaml").write_text(with_dependencies(Pipeline(Path.cwd())))


if __name__ == "__main__":
    main()
