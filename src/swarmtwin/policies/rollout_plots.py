"""Pictures, films and the viewer of a policy's roll-outs, from the files that they were saved in."""

from collections.abc import Mapping
from pathlib import Path

from swarmtwin.files import read_provenance
from swarmtwin.policies.rollout_comparison import MOTION_NAMES
from swarmtwin.policies.rollout_folder import ROLLOUTS
from swarmtwin.world.rendering.paths import paths_figure
from swarmtwin.world.rendering.video import pictures, write_video
from swarmtwin.world.rendering.viewer import write_viewer
from swarmtwin.world.rollout import Rollout, Show, chosen_world
from swarmtwin.world.rollout_storage import load_rollouts


def draw_rollout(made: Path, output: Path) -> None:
    """Draw into `output` what `swarmtwin rollout` left in `made`, with a film and a viewer where they were asked for.

    A folder of a version that had no viewer gets none.

    Raises:
        UserError: `made` is not a folder of swarmtwin's, or its roll-outs cannot be read.
    """
    _, options = read_provenance(made)
    rollouts = load_rollouts(made / ROLLOUTS)
    draw_paths(output / "rollouts.png", rollouts, options["show"])
    if options["video"]:
        draw_film(output / "rollout.mp4", rollouts, options["show"], options["speed"])
    if options.get("viewer", False):
        titled = {MOTION_NAMES[motion]: rollout for motion, rollout in rollouts.items()}
        write_viewer(output / "rollouts.html", titled, options["speed"])


def draw_paths(file: Path, rollouts: Mapping[str, Rollout], show: Show) -> None:
    """Draw the paths of one roll-out, the same start in all that moved the vehicles."""
    titled = {MOTION_NAMES[motion]: rollout for motion, rollout in rollouts.items()}
    paths_figure(titled, _shown(rollouts, show)).savefig(file)


def draw_film(file: Path, rollouts: Mapping[str, Rollout], show: Show, speed: float) -> None:
    """Film the same roll-out; `speed` is how many seconds pass in one second of the film."""
    titled = {MOTION_NAMES[motion]: rollout for motion, rollout in rollouts.items()}
    write_video(file, pictures(titled, _shown(rollouts, show), speed))


def _shown(rollouts: Mapping[str, Rollout], show: Show) -> int:
    """Return which roll-out to show, by how it went where it comes last: on stand-ins, where there are any."""
    return chosen_world(list(rollouts.values())[-1], show)
