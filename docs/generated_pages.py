"""Pages of the documentation that are made from the project itself, when `mkdocs build` calls these hooks.

The reference of commands and configurations comes from the comments in `conf/`, that of the code from its docstrings,
the notebooks' pages from the notebooks, those of results from what was computed; the architecture and the changelog lie
at the top of the repository.
"""

import html
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter
from result_pages import creates_page, experiment_entries, pipeline_page

from swarmtwin.commands.catalogue import COMMANDS
from swarmtwin.commands.option_help import ConfigFile, Option

REPOSITORY = Path(__file__).resolve().parents[1]
CONF = REPOSITORY / "conf"
PACKAGE = REPOSITORY / "src" / "swarmtwin"
NOT_API = {"commands", "studies"}  # of the code: commands have pages of their own, studies are run and not imported


@dataclass(frozen=True)
class Page:
    """A page that no file in docs/ holds: where it lies below docs/, its title, its Markdown, images beside it."""

    path: str
    title: str
    content: str
    images: tuple[tuple[str, bytes], ...] = ()


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Append the generated pages to the navigation."""
    assert config.nav is not None
    config.nav += [
        *experiment_entries(),
        {"Notebooks": _entries(notebook_pages())},
        {
            "Reference": [
                "reference/index.md",
                {"Commands": _entries(command_pages())},
                {"Experiments": _entries(experiment_pages())},
                {"Configuration": _entries(group_pages())},
                {"Code": _entries(api_pages())},
            ]
        },
        {"Changelog": "changelog.md"},
    ]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to those in docs/."""
    for page in [
        *notebook_pages(),
        *command_pages(),
        *experiment_pages(),
        *group_pages(),
        *api_pages(),
        top_page("ARCHITECTURE.md", "architecture.md"),
        top_page("CHANGELOG.md", "changelog.md"),
        Page("results/pipeline.md", "What make run shows", pipeline_page()),
        Page("results/creates/diagnosis.md", "Diagnosis of real robots", creates_page()),
    ]:
        files.append(File.generated(config, page.path, content=page.content))
        for name, image in page.images:
            files.append(File.generated(config, name, content=image))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Keep figures on one line with their spread and with the sign of per cent; set columns of words on the left."""
    markdown = re.sub(r"(?:^\|.*\|$\n?)+", lambda table: _words_on_the_left(table[0]), markdown, flags=re.MULTILINE)
    markdown = markdown.replace(" ± ", "\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}")
    return re.sub(r"(?<=\d)\s+%", "\N{NO-BREAK SPACE}%", markdown)


def _words_on_the_left(table: str) -> str:
    """Return a Markdown table in which a column that holds three words in a row is no longer set on the right."""
    rows = table.splitlines()
    columns = zip(*(row.strip("|").split("|") for row in rows), strict=False)
    aligned = []
    for _, ruler, *cells in columns:
        is_text = any(re.search(r"[a-z]{2,}\s[a-z]{2,}\s[a-z]{2,}", cell) for cell in cells)
        aligned.append(ruler.replace("---:", "---") if is_text else ruler)
    return "\n".join([rows[0], "|" + "|".join(aligned) + "|", *rows[2:]]) + "\n" if len(rows) > 2 else table


def _entries(pages: list[Page]) -> list[dict[str, str]]:
    return [{page.title: page.path} for page in pages]


def top_page(name: str, path: str) -> Page:
    """Return a file at the top of the repository as a page; links to others there lead to their pages."""
    content = (REPOSITORY / name).read_text()
    for there, here in {"DEPLOYMENT.md": "deploying.md", "ARCHITECTURE.md": "architecture.md"}.items():
        content = content.replace(f"]({there}", f"]({here}")
    return Page(path, path, content)


def notebook_pages() -> list[Page]:
    """Return the notebooks, with what they showed when they were run last."""
    pages = []
    for file in sorted((REPOSITORY / "notebooks").glob("*.ipynb")):
        exporter = MarkdownExporter()
        content, resources = exporter.from_filename(str(file), {"unique_key": file.stem})
        images = tuple((f"notebooks/{name}", image) for name, image in resources.get("outputs", {}).items())
        title = re.search(r"^# ([^:\n]+)", content, re.MULTILINE)
        note = (
            f"*This page is the notebook `notebooks/{file.name}` and what it showed; `make notebooks` runs it again.*"
        )
        content = re.sub(r"<style scoped>.*?</style>", "", content, flags=re.DOTALL)  # of pandas' tables
        content = content.replace('<table border="1" class="dataframe">', "<table>")
        head, _, rest = content.lstrip().partition("\n")
        pages.append(
            Page(f"notebooks/{file.stem}.md", title[1] if title else file.stem, f"{head}\n\n{note}\n\n{rest}", images)
        )
    return pages


def command_pages() -> list[Page]:
    """Return a page for each command: what it does, what is chosen, what can be set."""
    return [
        Page(f"reference/commands/{name}.md", name, _command_page(f"swarmtwin {name}", CONF / f"{name}.yaml"))
        for name in COMMANDS
        if name != "experiment"
    ]


def experiment_pages() -> list[Page]:
    """Return a page for each study that `swarmtwin experiment` runs."""
    return [
        Page(
            f"reference/experiments/{file.stem}.md",
            file.stem,
            _command_page(f"swarmtwin experiment name={file.stem}", file),
        )
        for file in sorted((CONF / "experiment").glob("*.yaml"))
    ]


def group_pages() -> list[Page]:
    """Return a page for each group of configurations, conf/<group>/, with a section for each file."""
    folders = sorted({file.parent for file in CONF.rglob("*.yaml")} - {CONF, CONF / "experiment"})
    return [_group_page(folder) for folder in folders]


def _group_page(folder: Path) -> Page:
    group = folder.relative_to(CONF).as_posix()
    lines = [f"# `{group}=`", "", f"Each of these is a file in `conf/{group}/`, chosen by its name.", ""]
    for file in sorted(folder.glob("*.yaml")):
        config = ConfigFile.read(file)
        prefix = group.rpartition("/")[2]
        lines += [f"## `{group}={file.stem}`", "", _prose(config.summary), "", *_option_list(config.options, prefix)]
    return Page(f"reference/configuration/{group.replace('/', '-')}.md", group, "\n".join(lines))


def _command_page(call: str, file: Path) -> str:
    config = ConfigFile.read(file)
    summary = config.summary.removeprefix(f"{call}: ")
    lines = [
        f"# `{call}`",
        "",
        _prose(summary[0].upper() + summary[1:]),
        "",
        "```sh",
        f"{call} option=value ...",
        "```",
        "",
    ]
    chosen = {name.partition("@")[0]: choice for name, choice in config.choices.items()}
    if chosen:
        lines += ["## Choices", "", "Each is a file in the folder of `conf/` that bears the option's name.", ""]
        lines += ["| option, as it is | others |", "| --- | --- |"]
    for group, choice in chosen.items():
        names = sorted(one.stem for one in (CONF / group).glob("*.yaml"))
        if not names:  # a group of a package that is installed beside swarmtwin
            continue
        link = f"../configuration/{group.replace('/', '-')}.md"
        lines.append(f"| [`{group}={choice}`]({link}) | {', '.join(f'`{name}`' for name in names if name != choice)} |")
    lines += ["", "## Options", "", *_option_list(config.options)]
    return "\n".join(lines)


def _option_list(options: list[Option], prefix: str = "") -> list[str]:
    """Return options as a table: name, default, what it means."""
    if not options:
        return []
    lines = ["| option | default | what it means |", "| --- | --- | --- |"]
    for one in options:
        name = f"{prefix}.{one.name}" if prefix else one.name
        default = {"???": "must be given", "": ""}.get(one.default, f"`{one.default}`".replace("|", "&#124;"))
        lines.append(f"| `{name}` | {default} | {_prose(one.sentence)} |")
    return [*lines, ""]


def _prose(sentence: str) -> str:
    """Return a comment as Markdown, in which nothing is markup but what stands between backticks."""
    parts = re.split(r"(`[^`]*`)", sentence)
    return "".join(
        part if part.startswith("`") else re.sub(r"([*_|\[\]])", r"\\\1", html.escape(part, quote=False))
        for part in parts
    )


def api_pages() -> list[Page]:
    """Return a page for each package of the code, with its modules in order, from their docstrings."""
    return [*_api_page(PACKAGE), *(page for folder in _packages() for page in _api_page(folder))]


def _packages() -> Iterator[Path]:
    for folder in sorted(path for path in PACKAGE.rglob("*") if (path / "__init__.py").is_file()):
        if folder.relative_to(PACKAGE).parts[0] not in NOT_API:
            yield folder


def _api_page(folder: Path) -> list[Page]:
    modules = [file for file in sorted(folder.glob("*.py")) if not file.stem.startswith("__")]
    if not modules:
        return []
    inside = folder.relative_to(PACKAGE).as_posix()
    package = ".".join(["swarmtwin", *folder.relative_to(PACKAGE).parts])
    lines = [f"# `{package}`", ""]
    for module in modules:
        lines += [f"## `{module.stem}`", "", f"::: {package}.{module.stem}", ""]
    name = "swarmtwin" if inside == "." else inside
    return [Page(f"reference/code/{name.replace('/', '-')}.md", name, "\n".join(lines))]
