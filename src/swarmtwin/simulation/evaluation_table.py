"""What a person reads of a simulation measured on a recording."""

from rich import box
from rich.table import Table

from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.simulation.evaluation import Floor, Measurement


def measurement_table(name: str, measurement: Measurement) -> Table:
    """Return the terminal's table: the figures of each vehicle, and of all; mean ± standard deviation."""
    title = f"{name}{', held-out runs' if measurement.held_out else ''}"
    floor = "floor" if measurement.overall.floor_kind == "exact" else "floor, estimate"
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=title)
    shown.add_column("\nvehicle", no_wrap=True)
    for heading in (
        "transi-\ntions",
        "one-step\nmm, °",
        f"{floor}\nmm, °",
        "model error\nmm, °",
        "open loop\nmm",
        "\nruns",
    ):
        shown.add_column(heading, justify="right", no_wrap=True)
    rows = list(measurement.vehicles.items())
    if len(rows) > 1:
        rows.append(("all", measurement.overall))
    for vehicle, figures in rows:
        errors = [_errors_text(figures.one_step), _floor_text(figures.best), _errors_text(figures.model_error)]
        loop = figures.open_loop
        loop_cells = (f"{loop.rmse_mm:.0f} ± {loop.rmse_sd_mm:.0f}", str(loop.runs)) if loop else ("", "")
        shown.add_row(vehicle, str(figures.one_step.transitions), *errors, *loop_cells)
    shown.caption = "mean ± standard deviation, position above orientation"
    if measurement.overall.best.estimate:
        shown.caption += "; floor with its 95 % interval"
    if history := measurement.overall.floors.get("history"):
        position, orientation = _floor_text(history).splitlines()
        kind = "" if history.kind == "exact" else ", estimate"
        shown.caption += f"\nfloor given the commands before as well{kind}: {position} mm, {orientation}°"
    if spread := measurement.overall.spread:
        covered = ", ".join(f"{100 * share:g} %: {100 * spread.covered(share):.1f}" for share in (0.5, 0.9, 0.95))
        shown.caption += f"\nshare of displacements in its intervals of {covered} %; {spread.nll_nats:.2f} nats each"
    return shown


def _floor_text(floor: Floor) -> str:
    if not floor.estimate:
        return _errors_text(floor.error)
    ends = (floor.estimate.position_mm, floor.estimate.orientation_deg)
    means = (floor.error.position_mm, floor.error.orientation_deg)
    return "\n".join(f"{mean:.2f} ({low:.2f}–{high:.2f})" for mean, (low, high) in zip(means, ends, strict=True))


def _errors_text(figure: ErrorFigure | None) -> str:
    if figure is None:
        return ""
    position = f"{figure.position_mm:.2f} ± {figure.position_sd_mm:.2f}"
    return f"{position}\n{figure.orientation_deg:.2f} ± {figure.orientation_sd_deg:.2f}"
