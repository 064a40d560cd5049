"""The Python in the README runs, in a folder as `make run` leaves it."""

import re
from pathlib import Path

from tiny_policies import robot_named, simulation

README = Path(__file__).resolve().parents[1] / "README.md"


def test_the_python_in_the_readme_runs(workplace):
    simulation(workplace / "artifacts" / "dynamics" / "mgr" / "crnet_synthetic", robot_named("mgr"))
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert blocks
    names: dict = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), names)
    assert all(names["terminated"].values()) or all(names["truncated"].values())
    assert names["env"].agents == []
