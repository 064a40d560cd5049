"""The kinds of task there are: every file in `tasks/`, found by its name."""

from swarmtwin.kinds import Kinds
from swarmtwin.world import tasks
from swarmtwin.world.task import TaskConfig

_KINDS: Kinds[TaskConfig] = Kinds(tasks, "kind of task", "task", field="kind")

task_kinds = _KINDS.names
config_class = _KINDS.config_class
task_config = _KINDS.config
