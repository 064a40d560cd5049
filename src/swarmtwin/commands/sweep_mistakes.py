"""What is wrong with all runs of a sweep: said before the first begins, as of a single run."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override, ValueType
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from swarmtwin.commands.option_mistakes import explain
from swarmtwin.configuration import config_files, config_folder
from swarmtwin.errors import UserError


def check_sweep(command: str, config_name: str, arguments: Sequence[str], most: int = 30) -> None:
    """Check what can be told of a sweep's runs without running them: each value is tried with the first of the others.

    Args:
        command: its name.
        config_name: the file in `conf/` that it begins with.
        arguments: as they were typed.
        most: of longer sweeps nothing is told: each run itself will see.

    Raises:
        UserError: an option or a choice does not exist, so Hydra would run nothing; or no run has what it is to read.
    """
    from swarmtwin.commands.inputs import check_inputs

    typed = get_args_parser().parse_args(list(arguments))
    if not typed.multirun or typed.config_dir or typed.config_path:  # whose choices Hydra knows alone
        return
    values = [_values(override) for override in OverridesParser.create().parse_overrides(typed.overrides)]
    if sum(len(own) - 1 for own in values) >= most:
        return
    first = [own[0] for own in values]
    others = [[*first[:place], value, *first[place + 1 :]] for place, own in enumerate(values) for value in own[1:]]
    contents = [_composed(config_name, run) for run in (first, *others)]
    faults: list[UserError] = []
    for content in contents:
        try:
            check_inputs(command, content)
        except UserError as error:
            faults.append(error)
    if len(faults) == len(contents):
        raise faults[0]


def _values(override: Override) -> list[str]:
    """Return an override with each value that a sweep gives it, of a range the ends."""
    if override.value_type == ValueType.GLOB_CHOICE_SWEEP:
        choices = cast(Glob, override.value()).filter(sorted(config_files(override.get_key_element())))
        return [f"{override.get_key_element()}={choice}" for choice in choices] or [str(override.input_line)]
    if override.value_type not in (ValueType.CHOICE_SWEEP, ValueType.SIMPLE_CHOICE_SWEEP, ValueType.RANGE_SWEEP):
        return [str(override.input_line)]
    values = [f"{override.get_key_element()}={value}" for value in override.sweep_string_iterator()]
    return values[:: max(1, len(values) - 1)] if override.value_type == ValueType.RANGE_SWEEP else values


def _composed(config_name: str, overrides: Sequence[str]) -> Mapping[str, Any]:
    try:
        with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
            config = hydra.compose(config_name, list(overrides))
        content = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(explain(error, config_name, overrides)) from None
    return cast(Mapping[str, Any], content)
