"""How Lightning trains: on what, with how many processes and digits, what is seen of it meanwhile, and when it ends."""

import inspect
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import Field, JsonValue, field_validator, model_validator

from swarmtwin.errors import near_miss
from swarmtwin.learning.device import Device
from swarmtwin.robot import StrictModel

Count = Annotated[int, Field(ge=1)]

SET_ELSEWHERE = {
    "accelerator": "device=... says where a training runs",
    "devices": "trainer.processes=... says how many share a training",
    "num_nodes": "a training stays on one machine, where trainer.processes=... may share it",
    "strategy": "write trainer.strategy=...",
    "precision": "write trainer.precision=...",
    "logger": "write trainer.logger=...",
    "callbacks": "a configuration names no code; trainer.patience_epochs=... ends a training early",
    "plugins": "a configuration names no code",
    "max_epochs": "recipe.epochs=... or the model's steps say how long it learns",
    "max_steps": "recipe.epochs=... or the model's steps say how long it learns",
    "accumulate_grad_batches": "a larger recipe.batch_size=... is the same, since the data lie in memory",
    "fast_dev_run": "recipe.epochs=1 is quick",
    "barebones": "what it leaves out is left out, or told by trainer.logger=none",
    "overfit_batches": "each epoch is judged by all validation runs",
    "limit_val_batches": "each epoch is judged by all validation runs",
    "val_check_interval": "each epoch is judged once",
    "check_val_every_n_epoch": "each epoch is judged once",
    "num_sanity_val_steps": "each epoch is judged once",
    "limit_test_batches": "`swarmtwin evaluate` measures on held-out runs",
    "limit_predict_batches": "`swarmtwin evaluate` measures on held-out runs",
    "enable_checkpointing": "write trainer.checkpoint_epochs=...",
    "enable_progress_bar": "write trainer.progress_bar=...",
    "enable_model_summary": "the MLflow run shows the model",
    "model_registry": "register=true registers the model in MLflow",
}
"""Options of `lightning.Trainer` that are not handed over by `TrainerSettings.options`, and what to do instead."""


class TrainerSettings(StrictModel):
    """What is passed on to `lightning.Trainer`; `conf/trainer/default.yaml` says the same.

    All of it tells a training apart from others: one that was interrupted goes on with the same settings alone.

    Attributes:
        name: the file's name.
        device: where to train.
        processes: that train a seed together, each on its share of every batch.
        strategy: Lightning's, by which they do.
        precision: Lightning's.
        logger: whether the errors of each epoch arrive in the MLflow run while one process learns; those of the seed
            that becomes the model stand there in the end, in any case.
        system_metrics: whether the run shows how busy the machine is, where the training takes ten seconds and more.
        progress_bar: what is seen in the terminal.
        checkpoint_epochs: so many epochs lie between two checkpoints.
        patience_epochs: end when the validation loss has not fallen for so many epochs; None: learn to the end.
        options: any other of `lightning.Trainer`'s, by their names there.
    """

    name: str = "default"
    device: Device = "auto"
    processes: Count = 1
    strategy: Literal["auto", "ddp_fork", "ddp_spawn"] = "auto"
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    logger: Literal["mlflow", "none"] = "mlflow"
    system_metrics: bool = True
    progress_bar: Literal["epochs", "rich", "none"] = "epochs"
    checkpoint_epochs: Count = 1
    patience_epochs: Count | None = None
    options: dict[str, JsonValue] = Field(default_factory=dict)

    @field_validator("options")
    @classmethod
    def _known_to_lightning(cls, options: dict[str, JsonValue]) -> dict[str, JsonValue]:
        if not options:
            return options
        import lightning  # seconds, only for those who name any

        known = inspect.signature(lightning.Trainer).parameters.keys() - SET_ELSEWHERE.keys()
        for name in options:
            if name in SET_ELSEWHERE:
                raise ValueError(f"{name!r} is set elsewhere: {SET_ELSEWHERE[name]}")
            if name not in known:
                raise ValueError(f"lightning.Trainer has no option {name!r}: {near_miss(name, known)}")
        return options

    @model_validator(mode="after")
    def _strategy_of_several(self) -> Self:
        if self.processes > 1 and self.strategy == "auto":
            raise ValueError("processes=2 and more want a strategy: trainer=ddp_cpu, or trainer.strategy=ddp_spawn")
        return self


class LiveCurves(NamedTuple):
    """The MLflow run that errors are sent to while a model learns.

    Attributes:
        run_id: the run.
        store: where it is kept.
    """

    run_id: str
    store: str
